"""Units of signals and of time, with their conversion factors to SI."""

from __future__ import annotations

import csv
import re
import unicodedata
from collections.abc import Mapping
from pathlib import Path

from ftlm.errors import DataError
from ftlm.structure.expression import Expression
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import as_mapping, join_names, nearest


def _read_units(kind: str) -> list[tuple[str, str, float, list[str]]]:
    """Return the entries of ``units.csv`` as (unit, SI unit, conversion factor to SI, spellings) tuples.

    `kind` is "signal" or "time".
    """
    with Path(__file__).with_name("units.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["kind"] == kind]
    return [(row["unit"], row["si"], float(row["factor"]), row["spellings"].split()) for row in rows]


_SIGNAL_ROWS, _TIME_ROWS = _read_units("signal"), _read_units("time")
#: (SI unit, conversion factor to SI) of each accepted signal unit.
SIGNAL_UNITS = {unit: (si, factor) for unit, si, factor, _ in _SIGNAL_ROWS}
#: Duration [s] of each unit of time.
TIME_UNITS = {unit: factor for unit, _, factor, _ in _TIME_ROWS}
#: Unit of each spelling in column headers. Spellings are case-folded, which replaces the micro sign by the letter mu.
#: Spellings of signal units have no spaces. A known unit without conversion is "".
_TIME_UNIT_ALIASES = {spelling: unit for unit, _, _, spellings in _TIME_ROWS for spelling in spellings}
_SIGNAL_UNIT_ALIASES = {spelling: unit for unit, _, _, spellings in _SIGNAL_ROWS for spelling in spellings}
_BRACKETED_UNIT_PATTERN = re.compile(r"(.*?)\s*\[\s*([^\[\]]*?)\s*\]")
_UNBRACKETED_UNIT_PATTERN = re.compile(r"(.+?)(?:\s*\(\s*([^()]*?)\s*\)|\s*[/,]\s*(\S+)|\s+in\s+(\S+)|_(\S+))")
_MAX_UNIT_CHARACTERS = 24
_TIME_NAMES = frozenset(("t", "time", "seconds"))


def split_time_header(name: str) -> tuple[str, str | None]:
    """Return the case-folded name and the unit of a time column from its header.

    The unit is a key of :data:`TIME_UNITS`, the text in square brackets if it is another unit, or None without a unit.
    Accepted forms: ``time [ms]``, ``time (ms)``, ``time/ms``, ``time, ms``, ``time in ms``, ``time_ms``.
    """
    folded = " ".join(name.split()).casefold()  # with runs of spaces, the patterns below would take cubic time
    bracketed = _BRACKETED_UNIT_PATTERN.fullmatch(folded)
    if bracketed and bracketed[2]:
        return bracketed[1], _TIME_UNIT_ALIASES.get(bracketed[2].rstrip("."), bracketed[2])
    unbracketed = _UNBRACKETED_UNIT_PATTERN.fullmatch(folded)
    unit_text = "" if unbracketed is None else next((part for part in unbracketed.groups()[1:] if part), "")
    unit = _TIME_UNIT_ALIASES.get(unit_text.rstrip("."))
    return (folded, None) if unbracketed is None or unit is None else (unbracketed[1], unit)


def parse_unit(word: str) -> str | None:
    """Return the key of :data:`SIGNAL_UNITS` for the text of a unit in a file.

    The key is "" for a known unit without conversion, and None for an unknown unit.

    Short symbols are case-sensitive (m and M differ), words are not. ``deg.``, ``N m`` and ``º`` are normalized.
    """
    if len(word) > _MAX_UNIT_CHARACTERS:
        return None
    # The ordinal sign and the ring are used as degree signs, and Ω and µ have two code points each.
    text = unicodedata.normalize("NFC", word.replace("º", "°").replace("˚", "°")).replace("μ", "µ").replace(" ", "")
    text = text.rstrip(".").replace("⁻¹", "^-1").replace("³", "3")
    if text in SIGNAL_UNITS:
        return text or None
    folded = text.casefold()
    return "" if folded in _TIME_UNIT_ALIASES else _SIGNAL_UNIT_ALIASES.get(folded)


def is_time_name(name: str) -> bool:
    """Whether a column name is t, time or seconds, with or without a unit."""
    return split_time_header(name)[0] in _TIME_NAMES


def time_unit_of(name: str, label: str, choice: str | None) -> tuple[str, tuple[str, ...]]:
    """Return the unit of a time column, and notes on it for the run.

    Parameters
    ----------
    name, label
        Name of the column, and its label in error messages.
    choice
        Unit given by the user, or None.

    Raises
    ------
    DataError
        If two units contradict each other, or the header has an unknown unit and the user gives none.
    """
    if choice is not None and (not isinstance(choice, str) or choice not in TIME_UNITS):
        raise DataError(f"{parameter('time_unit', choice)} is unknown; the known ones are {join_names(TIME_UNITS)}")
    unit_in_header = split_time_header(name)[1]
    if unit_in_header is None:
        return choice or "s", ()
    if unit_in_header not in TIME_UNITS:
        if choice is None:
            raise DataError(
                f"{label}: its header states the unit {unit_in_header!r}, which is unknown; the known ones are "
                f"{join_names(TIME_UNITS)}; give the unit of the numbers with {parameter('time_unit')}"
            )
        return choice, ()
    if choice is not None and TIME_UNITS[choice] != TIME_UNITS[unit_in_header]:
        raise DataError(
            f"{label}: its header states {unit_in_header!r}, and {parameter('time_unit', choice)} is given; leave "
            f"{parameter('time_unit')} out, or rename the column"
        )
    return unit_in_header, () if unit_in_header == "s" else (
        f"time read in {unit_in_header}, as the header {name!r} says",
    )


def check_units(units: Mapping[str, str] | None, signals: tuple[str, ...]) -> dict[str, tuple[str, float]]:
    """Return (SI unit, conversion factor) of every signal; raise DataError for an unknown signal or unit."""
    units_by_signal = as_mapping("units", {} if units is None else units)
    for signal, unit in units_by_signal.items():
        if signal not in signals:
            raise DataError(
                f"{parameter('units')}: {signal!r} is not a signal{nearest(signal, signals)}; the signals are "
                f"{join_names(signals)}"
            )
        if not isinstance(unit, str) or unit not in SIGNAL_UNITS:
            raise DataError(
                f"unit {unit!r} of signal {signal!r} is unknown{nearest(unit, SIGNAL_UNITS)}; "
                f"the known units are {join_names(SIGNAL_UNITS, len(SIGNAL_UNITS))}; convert other data before loading"
            )
    return {signal: SIGNAL_UNITS[str(units_by_signal.get(signal, ""))] for signal in signals}


def conversion_notes(units: Mapping[str, str]) -> tuple[str, ...]:
    """Return a tuple with a note that names the signals of a file that are converted to SI units; () without any.

    `units` has the unit in the file by signal. Results are in SI units, because numbers, limits and functions such as
    sin(y) in a structure are.
    """
    pairs = {name: (unit, SIGNAL_UNITS[unit]) for name, unit in units.items() if unit in SIGNAL_UNITS}
    converted = [f"{name} from {unit} to {si}" for name, (unit, (si, factor)) in pairs.items() if factor != 1.0]
    return (f"converted to SI units: {', '.join(converted)}",) if converted else ()


def coefficient_unit(units: Mapping[str, str], output: str, alpha: float, signal: str, order: float) -> str:
    """Return the unit of the coefficient of D^order signal in the equation of D^alpha output, such as ``s^-1.8 rad/A``.

    `units` has the units of signals by name. The result is empty if the coefficient is dimensionless, or if the unit of
    one of two different signals is unknown.
    """
    seconds = round(order - alpha, 4)
    time = "" if seconds == 0 else f"s^{seconds:g}"
    if signal == output or units.get(signal) == units.get(output) != "":
        return time
    output_unit, signal_unit = units.get(output, ""), units.get(signal, "")
    if not output_unit or not signal_unit:
        return ""
    signal_unit = f"({signal_unit})" if "/" in signal_unit or "·" in signal_unit else signal_unit
    ratio = output_unit if signal_unit == "1" else f"{output_unit}/{signal_unit}"
    return f"{time} {ratio}".strip()


def expression_unit(units: Mapping[str, str], expression: Expression) -> dict[str, float] | None:
    """Return the unit of an expression as exponents by unit; None if the unit of a signal is unknown.

    A sum has the unit of its first term with a signal. Functions other than abs and sqrt are dimensionless.
    """
    match expression.operation:
        case "constant":
            return {}
        case "channel":
            unit = units.get(expression.signal, "")
            exponents = {} if unit == "1" else {unit: 1.0}
            return _multiply_units(exponents, {"s": -expression.value}) if unit else None
        case "add":
            return expression_unit(units, next(a for a in expression.arguments if a.channels))
        case "multiply":
            powers: dict[str, float] | None = {}
            for argument in expression.arguments:
                factor = expression_unit(units, argument)
                powers = None if powers is None or factor is None else _multiply_units(powers, factor)
            return powers
        case "power" | "abs" | "sqrt":
            exponent = {"power": expression.value, "abs": 1.0, "sqrt": 0.5}[expression.operation]
            powers = expression_unit(units, expression.arguments[0])
            return None if powers is None else {unit: exponent * power for unit, power in powers.items()}
    return {}


def _multiply_units(first: Mapping[str, float], second: Mapping[str, float]) -> dict[str, float]:
    """Return the product of two units, each given as exponents by unit."""
    powers = {unit: first.get(unit, 0.0) + second.get(unit, 0.0) for unit in dict.fromkeys([*first, *second])}
    return {unit: power for unit, power in powers.items() if round(power, 9)}


def nonlinear_coefficient_unit(
    units: Mapping[str, str], output: str, alpha: float, expression: Expression, order: float
) -> str:
    """Return the unit of the coefficient of a non-linear term, such as ``s^-2 rad^-2``.

    The term is D^order of an expression, in the equation of D^alpha output. The result is empty if the unit of a signal
    is unknown or the coefficient is dimensionless.
    """
    output_unit, exponents = units.get(output, ""), expression_unit(units, expression)
    if not output_unit or exponents is None:
        return ""
    target = {"s": order - alpha} | ({} if output_unit == "1" else {output_unit: 1.0})
    powers = _multiply_units(target, {unit: -power for unit, power in exponents.items()})
    time = powers.pop("s", 0.0)
    numerator = [_unit_power(unit, power) for unit, power in powers.items() if power > 0]
    denominator = [_unit_power(unit, -power) for unit, power in powers.items() if power < 0]
    if numerator and denominator:
        divisor = "·".join(denominator)
        ratio = f"{'·'.join(numerator)}/{f'({divisor})' if len(denominator) > 1 else divisor}"
    else:
        ratio = "·".join(numerator) or "·".join(_unit_power(unit, power) for unit, power in powers.items())
    seconds = f"s^{round(time, 4):g}" if round(time, 4) else ""
    return f"{seconds} {ratio}".strip()


def _unit_power(unit: str, power: float) -> str:
    """Return a power of a unit as text, such as ``(rad/s)^2``."""
    compound = "/" in unit or "·" in unit
    if power == 1:
        return f"({unit})" if compound else unit
    return f"{f'({unit})' if compound else unit}^{power:g}"
