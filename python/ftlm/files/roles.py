"""What the names of columns say of them: inputs, outputs, units, and names that equations can hold."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from ftlm.data.names import CSV_TIME
from ftlm.data.units import spelled_unit
from ftlm.files.cells import stated_unit

_DRIVES = frozenset(
    ("u", "in", "inp", "input", "eingang", "cmd", "command", "current", "strom", "torque", "drehmoment", "pwm", "duty",
     "drive", "force", "kraft", "power", "leistung", "heater", "heating", "excitation", "anregung", "actuator", "i",
     "im", "valve", "ventil", "throttle")
)  # fmt: skip
_FOLLOWS = frozenset(
    ("y", "out", "output", "ausgang", "angle", "winkel", "position", "pos", "weg", "displacement", "deflection",
     "auslenkung", "theta", "th", "temp", "temperature", "temperatur", "speed", "velocity", "drehzahl",
     "geschwindigkeit", "acceleration", "accel", "beschleunigung", "level", "pressure", "druck", "response",
     "antwort", "strain", "dehnung", "tip")
)  # fmt: skip
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
