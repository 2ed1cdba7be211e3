"""Units of signals and of time, and their SI values."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping

from ftlm.errors import DataError
from ftlm.utils.validation import as_mapping, listed, nearest

#: SI unit of each unit that a person may write, and its value in it.
UNITS: dict[str, tuple[str, float]] = {
    "": ("", 1.0),
    "1": ("1", 1.0),
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180.0),
    "°": ("rad", math.pi / 180.0),
    "mrad": ("rad", 1e-3),
    "A": ("A", 1.0),
    "mA": ("A", 1e-3),
    "V": ("V", 1.0),
    "mV": ("V", 1e-3),
    "m": ("m", 1.0),
    "cm": ("m", 1e-2),
    "mm": ("m", 1e-3),
    "s": ("s", 1.0),
    "N": ("N", 1.0),
    **dict.fromkeys(("N·m", "N⋅m", "N*m", "N.m", "Nm"), ("N·m", 1.0)),
    **dict.fromkeys(("degC", "°C", "C"), ("degC", 1.0)),
    "K": ("K", 1.0),
    "rad/s": ("rad/s", 1.0),
    "deg/s": ("rad/s", math.pi / 180.0),
    "rpm": ("rad/s", 2.0 * math.pi / 60.0),
    "m/s": ("m/s", 1.0),
    "m/s^2": ("m/s^2", 1.0),
    "m/s²": ("m/s^2", 1.0),
    "g": ("m/s^2", 9.80665),
    "Pa": ("Pa", 1.0),
    "kPa": ("Pa", 1e3),
    "W": ("W", 1.0),
    "Hz": ("Hz", 1.0),
    "hPa": ("Pa", 1e2),
    "MPa": ("Pa", 1e6),
    "mbar": ("Pa", 1e2),
    "bar": ("Pa", 1e5),
    "kN": ("N", 1e3),
    "mN·m": ("N·m", 1e-3),
    "mNm": ("N·m", 1e-3),
    "kW": ("W", 1e3),
    "kHz": ("Hz", 1e3),
    "kV": ("V", 1e3),
    "mm/s": ("m/s", 1e-3),
    "km/h": ("m/s", 1.0 / 3.6),
    "µm": ("m", 1e-6),
    "µA": ("A", 1e-6),
    "µV": ("V", 1e-6),
}
TIME_UNITS: dict[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "min": 60.0, "h": 3600.0}

#: Other ways to write them in the header of a column, without capitals.
_WRITTEN = {
    **{unit: unit for unit in TIME_UNITS},
    "μs": "us",  # the letter mu, into which casefold turns the micro sign
    **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
    "hr": "h",
    "hour": "h",
    "hours": "h",
    **dict.fromkeys(("msec", "millisecond", "milliseconds"), "ms"),
    "minute": "min",
    "minutes": "min",
    **dict.fromkeys(("usec", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("sekunde", "sekunden", "sek"), "s"),
    "millisekunden": "ms",
    "minuten": "min",
    "stunden": "h",
    **dict.fromkeys(("millisec", "millisecs", "msek"), "ms"),
    "std": "h",
    "mikrosekunden": "us",
}
#: Other ways to write units of signals in files, without capitals and spaces; of those of "" nothing is converted.
_SPELLED = {
    **{
        name: unit
        for unit, names in {
            "deg": "degree degrees degs grad grd winkelgrad",
            "rad": "radian radians radiant",
            "deg/s": "°/s deg/sec dps grad/s grd/s degree/s degrees/s degrees/sec",
            "rad/s": "rad/sec rads/s rad·s^-1",
            "rpm": "rpm u/min 1/min r/min rev/min min^-1 min-1 upm u.p.m r.p.m",
            "A": "amp amps ampere amperes",
            "mA": "milliamp milliamps milliampere",
            "V": "volt volts vdc",
            "mV": "millivolt millivolts",
            "m": "metre metres meter meters",
            "cm": "centimetre centimeter zentimeter",
            "mm": "millimetre millimetres millimeter millimeters",
            "µm": "micron microns um",
            "µA": "ua",
            "µV": "uv",
            "N": "newton newtons",
            "N·m": "newtonmeter newtonmetre newtonmetres newtonmeters",
            "degC": "celsius gradcelsius gradc degcelsius",
            "K": "kelvin",
            "W": "watt watts",
            "Hz": "hertz",
            "Pa": "pascal",
            "m/s^2": "m/s2 m/s^2 m/s/s m/sec^2 m/sec2",
            "m/s": "m/sec",
        }.items()
        for name in names.split()
    },
    **dict.fromkeys(
        (
            "%",
            "-",
            "db",
            "mhz",
            "mw",
            "kg",
            "l/min",
            "m3/h",
            "nm",
            "ohm",
            "ω",
            "mω",
            "kω",
            "ma",
            "1/s",
            "s^-1",
            "a.u",
            "none",
            "count",
            "counts",
            "lsb",
            "j",
            "kj",
            "ah",
            "vac",
            "vrms",
            "arms",
            "degf",
            "°f",
            "ft",
            "inch",
            "psi",
            "lbf",
            "kgf",
            "gauss",
            "mpa",
            "mn",
        ),
        "",
    ),
}
_BRACKETED = re.compile(r"(.*?)\s*\[\s*([^\[\]]*?)\s*\]")
_OTHERWISE = re.compile(r"(.+?)(?:\s*\(\s*([^()]*?)\s*\)|\s*[/,]\s*(\S+)|\s+in\s+(\S+)|_(\S+))")
_LONGEST_UNIT = 24
_TIME_NAMES = frozenset(("t", "time", "seconds"))


def header_time(name: str) -> tuple[str, str | None]:
    """Split the name of a column of times into what it is called, without capitals, and the unit that it states.

    The unit is one of :data:`TIME_UNITS`, None where none is stated, and as it stands where square brackets hold
    something else. Written as in ``time [ms]``, ``time (ms)``, ``time/ms``, ``time, ms``, ``time in ms``, ``time_ms``.
    """
    folded = " ".join(name.split()).casefold()  # runs of spaces would cost their cube below
    bracketed = _BRACKETED.fullmatch(folded)
    if bracketed and bracketed[2]:
        return bracketed[1], _WRITTEN.get(bracketed[2].rstrip("."), bracketed[2])
    otherwise = _OTHERWISE.fullmatch(folded)
    stated = "" if otherwise is None else next((part for part in otherwise.groups()[1:] if part), "")
    unit = _WRITTEN.get(stated.rstrip("."))
    return (folded, None) if otherwise is None or unit is None else (otherwise[1], unit)


def spelled_unit(word: str) -> str | None:
    """The unit of :data:`UNITS` that a word in a file means, "" where it is one of no conversion, None where none.

    Short ones by their letters, since m and M differ; words without capitals; ``deg.``, ``N m`` and ``º`` as meant.
    """
    if len(word) > _LONGEST_UNIT:
        return None
    # The ordinal sign and the ring are typed for the degree; Ω and µ have two signs each.
    text = unicodedata.normalize("NFC", word.replace("º", "°").replace("˚", "°")).replace("μ", "µ").replace(" ", "")
    text = text.rstrip(".").replace("⁻¹", "^-1").replace("³", "3")
    if text in UNITS:
        return text or None
    folded = text.casefold()
    return "" if folded in _WRITTEN else _SPELLED.get(folded)


def is_time_name(name: str) -> bool:
    """Whether a column is called the time: t, time or seconds, with or without a unit."""
    return header_time(name)[0] in _TIME_NAMES


def time_unit_of(name: str, label: str, given: str | None) -> tuple[str, tuple[str, ...]]:
    """Return the unit of a column of times, and what a run is to say of it.

    Parameters
    ----------
    name, label
        The column's own name, and what errors call it.
    given
        The unit that a person states, or None.

    Raises
    ------
    DataError
        Two units that contradict each other, or a unit in the header that is not known where none is given.
    """
    if given is not None and (not isinstance(given, str) or given not in TIME_UNITS):
        raise DataError(f"time_unit={given!r} is unknown; the known ones are {listed(TIME_UNITS)}")
    stated = header_time(name)[1]
    if stated is None:
        return given or "s", ()
    if stated not in TIME_UNITS:
        if given is None:
            raise DataError(
                f"{label}: its header states the unit {stated!r}, which is unknown; the known ones are "
                f"{listed(TIME_UNITS)}; say with time_unit= in which the numbers are"
            )
        return given, ()
    if given is not None and TIME_UNITS[given] != TIME_UNITS[stated]:
        raise DataError(
            f"{label}: its header states {stated!r}, and time_unit={given!r} is asked for; leave time_unit= out, or "
            "rename the column"
        )
    return stated, () if stated == "s" else (f"time read in {stated}, as the header {name!r} says",)


def checked_units(units: Mapping[str, str] | None, signals: tuple[str, ...]) -> dict[str, tuple[str, float]]:
    """Return SI unit and factor of every signal; one without a unit is taken as it is."""
    given = as_mapping("units", {} if units is None else units)
    for signal, unit in given.items():
        if signal not in signals:
            raise DataError(
                f"units=: {signal!r} is not a signal{nearest(signal, signals)}; the signals are {listed(signals)}"
            )
        if not isinstance(unit, str) or unit not in UNITS:
            raise DataError(
                f"unit {unit!r} of signal {signal!r} is unknown{nearest(unit, UNITS)}; "
                f"the known units are {listed(UNITS, len(UNITS))}; convert other data before loading"
            )
    return {signal: UNITS[str(given.get(signal, ""))] for signal in signals}


def coefficient_unit(units: Mapping[str, str], output: str, alpha: float, signal: str, order: float) -> str:
    """Unit of the coefficient of D^order of a signal in the equation of D^alpha of an output, ``s^-1.8 rad/A``.

    Empty where the unit of one of two signals is not known, and where there is none.
    """
    seconds = round(order - alpha, 4)
    time = "" if seconds == 0 else f"s^{seconds:g}"
    if signal == output or units.get(signal) == units.get(output) != "":
        return time
    above, below = units.get(output, ""), units.get(signal, "")
    if not above or not below:
        return ""
    below = f"({below})" if "/" in below or "·" in below else below
    ratio = above if below == "1" else f"{above}/{below}"
    return f"{time} {ratio}".strip()
