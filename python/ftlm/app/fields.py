"""What the fields of the page say of a file, as arguments of `ftlm.open_file`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ftlm.base.errors import DataError

#: Fields of a file's layout that hold whole numbers, and those that hold words.
NUMBERS, WORDS = ("skip", "header"), ("encoding", "separator", "decimal", "thousands", "dates", "sheet")
ROLES = ("", "time", "input", "output")
MOST_SIGNALS = 500


def asked_of(said: Mapping[str, Any]) -> dict[str, Any]:
    """Turn fields into arguments; an empty field says nothing.

    Parameters
    ----------
    said
        ``columns``: a list of name, role, signal and unit; ``step``, ``resample``, ``from``, ``to``: text of numbers;
        ``time_unit``, ``missing`` and those of the layout: words.

    Raises
    ------
    DataError
        A field that is none of these, or holds no number where one belongs.
    """
    asked: dict[str, Any] = {}
    for name in ("step", "resample"):
        if _text(said, name):
            asked[name] = number(name, _text(said, name))
    for name in ("time_unit", "missing"):
        if _text(said, name):
            asked[name] = _text(said, name)
    ends = [number(name, _text(said, name)) if _text(said, name) else None for name in ("from", "to")]
    if ends != [None, None]:
        asked["slice"] = ends
    layout: dict[str, Any] = {name: _text(said, name) for name in WORDS if _text(said, name)}
    layout |= {name: _whole(name, _text(said, name)) for name in NUMBERS if _text(said, name)}
    if layout:
        asked["layout"] = layout
    return asked | _roles(said.get("columns"))


def _roles(columns: Any) -> dict[str, Any]:
    """Time, inputs, outputs and units; nothing where no column is told."""
    if columns is None:
        return {}
    if not isinstance(columns, list) or len(columns) > MOST_SIGNALS:
        raise DataError(f"columns is no list of at most {MOST_SIGNALS} columns")
    asked: dict[str, Any] = {}
    for entry in columns:
        if not isinstance(entry, Mapping):
            raise DataError("a column is no object with name, role, signal and unit")
        name, role = _text(entry, "name"), _text(entry, "role")
        signal, unit = _text(entry, "signal") or name, _text(entry, "unit")
        if role not in ROLES:
            raise DataError(f"the role {role!r} of column {name!r} is not known; take time, input, output or none")
        if role == "time":
            if "time" in asked:
                raise DataError(f"{asked['time']!r} and {name!r} are both the time; keep one of them")
            asked["time"] = name
        elif role:
            signals = asked.setdefault(f"{role}s", {})
            if signal in signals or signal in asked.get("inputs", {}) or signal in asked.get("outputs", {}):
                raise DataError(f"two columns are called {signal!r}; give each signal a name of its own")
            signals[signal] = name
            if unit:
                asked.setdefault("units", {})[signal] = unit
    return asked


def number(name: str, text: str) -> float:
    """A number of a field."""
    try:
        return float(text)
    except ValueError:
        raise DataError(f"{name}: {text[:40]!r} is no number; write one such as 0.5") from None


def _whole(name: str, text: str) -> int:
    """A whole number of a field."""
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise DataError(f"{name}: {text[:40]!r} is no number of lines; write one such as 2")
    return int(text)


def _text(said: Mapping[str, Any], name: str) -> str:
    value = said.get(name)
    if value is None:
        return ""
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise DataError(f"{name} is no text; write one")
    return str(value).strip() if name not in ("name",) else str(value)
