"""Words of the command line that hold several things: NAME=VALUE, FROM:TO, numbers joined by a colon."""

from __future__ import annotations

import re

from ftlm.base.errors import ModelError

#: What the command line calls an argument of Python.
OPTIONS = {
    "method": "--method", "coefficients": "--coefficients", "criterion": "--criterion", "norm": "--norm",
    "lattice": "--lattice or --step", "innovation_length": "--p", "prior_covariance": "--k0", "rows": "--rows",
    "m": "--m", "keep": "--keep", "threads": "--threads", "store": "--store", "genetic": "--seed or --evaluations",
    "slice": "--slice", "resample": "--resample", "step": "--sampling", "time": "--time", "time_unit": "--time-unit",
    "units": "--unit", "columns": "--columns", "intersample": "--intersample", "inputs": "-u", "outputs": "-y",
    "coupling": "--coupling", "initial": "--initial", "laws": "--laws", "form": "--form",
    "input_order": "--input-order",
    "friction": "--friction", "cross_stage": "--cross-stage", "cross_sensitivity": "--cross-sensitivity",
    "cross_damping": "--cross-damping",
    "tolerance": "--tolerance", "lags": "--lags",
    "delay": "--delay", "force": "--force", "offset": "--offset", "reference": "--reference", "start": "--start",
    "validation": "--validation",
    "loss": "--loss", "intervals": "--intervals", "missing": "--missing",
    "encoding": "--encoding", "separator": "--separator", "decimal": "--decimal", "skip": "--skip",
    "thousands": "--thousands",
    "weights": "--weights", "frequency_unit": "--frequency-unit", "magnitude_unit": "--magnitude-unit",
    "phase_unit": "--phase-unit", "negated": "--negated",
    "duration": "--duration", "peak": "--peak", "slew": "--slew", "limits": "--limit", "names": "--for",
    "noise": "--noise", "period": "--period", "like": "--like",
    "crossover": "--crossover", "phase_margin": "--phase-margin", "effort": "--effort", "drift": "--drift",
    "allowed": "--allowed", "band": "--band", "poles": "--poles", "samples": "--samples", "rate": "--rate",
    "measured": "--measured", "limit": "--limit", "input": "--input", "output": "--output", "of": "--of",
    "kind": "--kind", "modes_shaped": "--modes",
    "header": "--header", "dates": "--dates", "sheet": "--sheet",
}  # fmt: skip
#: ``force=True (--force)``, where the option stands beside the argument already.
_BESIDE = re.compile(r"\b\w+=\S* \((--[a-z-]+)\)")
#: What a run is cut by, whose ends a command takes joined by a colon.
_CUT = re.compile(r"\bslice\((\S+), (?:None|(\S+?))\)")
#: What Python says of a layout, whose keys are options of their own.
_LAYOUT = re.compile(r"layout=dict\(([^()]*)\)")
_COMMANDS = re.compile(r" \(commands: [^)]*\)")
#: ``-u m=3`` is a name that a user gave, not an argument.
_ARGUMENT = re.compile(r"(--?[\w-]+ )?(?<![^\s(])(" + "|".join(OPTIONS) + r")=(?:'([^']*)'|([\w.+-]+))?(?![\w{])")
_BARE = re.compile(r"\b(innovation_length|prior_covariance|time_unit)\b(?!=)")


def in_options(text: str) -> str:
    """Return a message in which the options of the command line stand for the arguments of Python."""
    text = text.replace("inputs={name: column}", "-u NAME=COLUMN").replace("outputs={name: column}", "-y NAME=COLUMN")
    text = text.replace("columns={part: column}", "--column PART=COLUMN")
    text = _LAYOUT.sub(lambda found: found[1].replace(", ", " "), text).replace("layout=: ", "")
    text = text.replace("in a columns file", "in a file for --columns")
    text = _CUT.sub(lambda found: f"--slice {found[1]}:{found[2] or ''}", text)
    text = _BESIDE.sub(r"\1", _COMMANDS.sub("", text))
    return _BARE.sub(lambda found: OPTIONS[found[1]], _ARGUMENT.sub(_as_option, text))


def _as_option(found: re.Match[str]) -> str:
    before, name, quoted, bare = found.groups()
    if before:
        return found[0]
    value = quoted or bare or ""
    return OPTIONS[name] if value in ("", "True") else f"{OPTIONS[name]} {value}"


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


def ranges(option: str, given: list[str] | None) -> dict[str, float | tuple[float, float]]:
    """INPUT=NUMBER options, or INPUT=LEAST:LARGEST where the number is to be estimated."""
    what, example = ("seconds", "0:0.02") if option == "--delay" else ("a number", "0.5:1.5")
    values: dict[str, float | tuple[float, float]] = {}
    for name, value in pairs(option, given).items():
        ends = joined(value)
        if len(ends) not in (1, 2):
            raise ModelError(f"{option} {name}={value}: {value!r} is neither {what} nor LEAST:LARGEST, as in {example}")
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
