"""Words of the command line that hold several things: NAME=VALUE, FROM:TO, numbers joined by a colon."""

from __future__ import annotations

import re

from ftlm.base.errors import ModelError


def pairs(option: str, given: list[str] | None) -> dict[str, str]:
    """NAME=VALUE options as a dictionary; a bare NAME stands for NAME=NAME."""
    values: dict[str, str] = {}
    for item in given or []:
        name, equals, value = item.partition("=")
        value = value if equals else name
        if not equals and name and not re.fullmatch(r"[^\W\d][\w.\[\]]*", name):
            short = re.sub(r"\W+", "_", name.partition("(")[0]).strip("_0123456789").lower() or "name"
            raise ModelError(
                f'{option} {item!r} has no name of its own; write NAME=…, such as {option} "{short}={item}"'
            )
        if not name or not value:
            raise ModelError(f"{option} {item!r} is not NAME=VALUE")
        if name in values:
            raise ModelError(f"{option} names {name!r} twice")
        values[name] = value
    return values


def numbers(option: str, given: list[str] | None) -> dict[str, float]:
    """NAME=NUMBER options as a dictionary."""
    values = {}
    for name, value in pairs(option, given).items():
        try:
            values[name] = float(value)
        except ValueError:
            raise ModelError(f"{option} {name}={value}: {value!r} is no number") from None
    return values


def delays(given: list[str] | None) -> dict[str, float | tuple[float, float]]:
    """INPUT=SECONDS options, or INPUT=LEAST:LARGEST where the delay is to be estimated."""
    values: dict[str, float | tuple[float, float]] = {}
    for name, value in pairs("--delay", given).items():
        ends = joined(value)
        if len(ends) not in (1, 2):
            raise ModelError(f"--delay {name}={value}: {value!r} is neither seconds nor LEAST:LARGEST, as in 0:0.02")
        values[name] = ends[0] if len(ends) == 1 else (ends[0], ends[1])
    return values


def interval(text: str, option: str, example: str) -> tuple[float | None, float | None]:
    """FROM:TO, either end optional."""
    parts = text.split(":")
    try:
        if len(parts) != 2:
            raise ValueError
        start, stop = (float(p) if p.strip() else None for p in parts)
    except ValueError:
        raise ModelError(f"{option} {text!r} is no FROM:TO, such as {example}") from None
    return start, stop


def several(option: str, text: str, *counts: int) -> list[float]:
    """As many numbers joined by a colon as may be."""
    values = joined(text)
    if len(values) not in counts:
        raise ModelError(f"{option} {text!r} is not {' or '.join(str(c) for c in counts)} numbers joined by a colon")
    return values


def joined(text: str) -> list[float]:
    """Numbers joined by a colon; none where one cannot be read."""
    try:
        return [float(part) for part in text.split(":")]
    except ValueError:
        return []
