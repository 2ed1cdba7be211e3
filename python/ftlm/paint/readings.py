"""What the slider of a chart reads out: values of its lines at instants, short enough to lie in the page."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence

import numpy as np

from ftlm.base.arrays import Floats

#: Places of a slider: more than its track has pixels.
PLACES = 750
#: Parts into which the span of a line is divided: five digits of it.
PARTS = 1e5


def readings(
    x: Floats, lines: Sequence[tuple[str, int, Floats]], x_label: str, y_label: str, places: int = PLACES
) -> str:
    """Values of lines at the places of a slider, as JSON of whole numbers.

    Parameters
    ----------
    x
        Shape (N,), ascending.
    lines
        (name, style, values of shape (N,)), not a number where there is none.
    x_label, y_label
        Text, a unit at its end in brackets.
    places
        About as many at most.

    Returns
    -------
    str
        Every place is a sample. That at which the first two lines are farthest apart is among them, and is said.
    """
    there = np.flatnonzero(np.isfinite(x))
    if not there.size or not lines:
        return ""
    chosen = there[:: max(1, math.ceil(there.size / min(places, PLACES)))]
    begin = None
    if len(lines) > 1:
        apart = np.abs(lines[0][2][there] - lines[1][2][there])
        if np.isfinite(apart).any():
            begin = there[int(np.nanargmax(apart))]
    chosen = np.unique(np.append(chosen, [there[-1], *([] if begin is None else [begin])]))
    name, unit = _parted(x_label)
    told = {
        "name": name, "unit": unit, "y": _parted(y_label)[1], "at": _whole(x[chosen]),
        "begin": 0 if begin is None else int(np.searchsorted(chosen, begin)), "apart": begin is not None,
        "lines": [{"name": n, "style": s, "at": _whole(y[chosen])} for n, s, y in lines],
    }  # fmt: skip
    return json.dumps(told, separators=(",", ":"), allow_nan=False)


def _parted(label: str) -> tuple[str, str]:
    """What an axis shows and in which unit."""
    bare, bracket, unit = label.rpartition(" [")
    return (bare, unit[:-1]) if bracket and unit.endswith("]") else (label, "")


def _whole(values: Floats) -> list[object]:
    """A power of ten and whole numbers that times it are the values; null for none."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return [0, [None] * values.size]
    low, high = float(finite.min()), float(finite.max())
    largest = max(abs(low), abs(high))
    # Beyond twelve digits of the largest value a browser's numbers have no whole ones.
    fine = max((high / PARTS - low / PARTS), largest * 1e-12, 1e-290)
    power = math.floor(math.log10(fine))
    scaled = values / 10.0**power
    return [power, [None if math.isnan(v) else round(v) for v in scaled.tolist()]]
