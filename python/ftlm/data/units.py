"""Units of signals and of time, and their SI values."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ftlm.base.checks import as_mapping, listed, nearest
from ftlm.base.errors import DataError

#: SI unit of each unit that a person may write, and its value in it.
UNITS: dict[str, tuple[str, float]] = {
    "": ("", 1.0), "1": ("1", 1.0),
    "rad": ("rad", 1.0), "deg": ("rad", math.pi / 180.0), "°": ("rad", math.pi / 180.0), "mrad": ("rad", 1e-3),
    "A": ("A", 1.0), "mA": ("A", 1e-3), "V": ("V", 1.0), "mV": ("V", 1e-3),
    "m": ("m", 1.0), "cm": ("m", 1e-2), "mm": ("m", 1e-3), "s": ("s", 1.0), "N": ("N", 1.0),
    **dict.fromkeys(("N·m", "N⋅m", "N*m", "N.m", "Nm"), ("N·m", 1.0)),
    **dict.fromkeys(("degC", "°C", "C"), ("degC", 1.0)), "K": ("K", 1.0),
    "rad/s": ("rad/s", 1.0), "deg/s": ("rad/s", math.pi / 180.0), "rpm": ("rad/s", 2.0 * math.pi / 60.0),
    "m/s": ("m/s", 1.0), "m/s^2": ("m/s^2", 1.0), "m/s²": ("m/s^2", 1.0), "g": ("m/s^2", 9.80665),
    "Pa": ("Pa", 1.0), "kPa": ("Pa", 1e3), "W": ("W", 1.0), "Hz": ("Hz", 1.0),
}  # fmt: skip
TIME_UNITS: dict[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "min": 60.0, "h": 3600.0}


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
                f"the known units are {listed(UNITS)}; convert other data before loading"
            )
    return {signal: UNITS[str(given.get(signal, ""))] for signal in signals}
