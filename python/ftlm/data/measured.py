"""The record of one measured experiment: what verbs read of a run."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftlm.base.arrays import Floats
from ftlm.base.checks import listed, nearest
from ftlm.base.errors import DataError
from ftlm.data.readings import Readings, bridged, read, unread
from ftlm.data.samples import Intersample, grid_of, is_constant, locked


@dataclass(frozen=True, eq=False, repr=False)
class Measured:
    """Regular samples of named inputs and outputs in SI units; :class:`ftlm.Run` is what people hold.

    Parameters
    ----------
    name
        What reports call it.
    step, start
        Time between rows, and source time of the first row [s].
    inputs, outputs
        Names.
    facts
        What was done to the data, and what a rig said of them, in words.
    readings
        Rows at times of their own, where these are not those of the grid; on the grid stand means of the hold and
        straight lines.
    """

    name: str
    step: float
    start: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    _data: dict[str, Floats]
    _units: dict[str, str]
    _intersample: dict[str, Intersample]
    facts: tuple[str, ...] = ()
    _about: dict[str, Any] = field(default_factory=dict)
    readings: Readings | None = None

    def __post_init__(self) -> None:
        for name, value in (
            ("_data", {s: locked(self._data[s]) for s in self.signals}),
            ("_units", {s: self._units[s] for s in self.signals}),
            ("_intersample", {s: self._intersample[s] for s in self.inputs}),
            ("_about", copy.deepcopy(self._about)),
        ):
            object.__setattr__(self, name, value)
        if self.readings is not None:
            own = Readings(locked(self.readings.times), {s: locked(self.readings.data[s]) for s in self.signals})
            object.__setattr__(self, "readings", own)

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the inputs, then of the outputs."""
        return self.inputs + self.outputs

    @property
    def units(self) -> dict[str, str]:
        """SI unit of every signal; "" where none was given. A copy."""
        return dict(self._units)

    @property
    def intersample(self) -> dict[str, Intersample]:
        """Behaviour of every input between rows, "zoh" or "foh". A copy."""
        return dict(self._intersample)

    @property
    def length(self) -> int:
        """Number of rows N."""
        return int(self._data[self.outputs[0]].size)

    @property
    def duration(self) -> float:
        """Time from the first row to the last, (N − 1)·step [s]."""
        return (self.length - 1) * self.step

    @property
    def time(self) -> Floats:
        """Time of every row [s], from 0, shape (N,), read-only."""
        return locked(grid_of(self.length, self.step))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was done to the data and what is odd about them, in words."""
        there = {name: read(self._data[name]) for name in self.outputs}
        constant = tuple(
            f"output {name!r} is constant ({float(values[0])!r} in all {values.size} rows): nothing can be identified "
            "from it"
            for name, values in there.items()
            if values.size and is_constant(values)
        )
        return self.facts + constant

    @property
    def missing(self) -> dict[str, NDArray[np.bool_]]:
        """Outputs that were not read throughout, with the rows of the run (or of its `readings`) that hold no value."""
        data = self._data if self.readings is None else self.readings.data
        gone = {name: unread(data[name]) for name in self.outputs}
        return {name: rows for name, rows in gone.items() if rows.any()}

    def bridged(self) -> Measured:
        """The same with straight lines over what was not read, for a first look; nothing is fitted to these."""
        if not any(unread(self._data[name]).any() for name in self.outputs):
            return self
        told = {f.name: getattr(self, f.name) for f in fields(Measured)}
        return Measured(**{**told, "_data": {name: bridged(values) for name, values in self._data.items()}})

    @property
    def about(self) -> dict[str, Any]:
        """How the run was made, for JSON: a rig says its name, seed, input, parameters and faults. A copy."""
        return copy.deepcopy(self._about)

    def __getitem__(self, name: str) -> Floats:
        """Return a signal in SI units, shape (N,), read-only; `DataError` for an unknown name."""
        try:
            return self._data[name]
        except (KeyError, TypeError):
            raise self._unknown(name) from None

    def __contains__(self, name: object) -> bool:
        return name in self.signals

    def _unknown(self, name: object) -> DataError:
        return DataError(
            f"signal {name!r} is not in run {self.name!r}{nearest(name, self.signals)}; "
            f"its signals are {listed(self.signals)}"
        )
