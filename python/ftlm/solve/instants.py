"""Where the samples of a run stand on a grid of pulses, when they have times of their own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.data.readings import Readings
from ftlm.data.run import Run
from ftlm.data.samples import HELD
from ftlm.data.structures import Structure
from ftlm.solve.records import Record, acting


def has_own_times(run: Run, structure: Structure) -> bool:
    """Whether a run's outputs are compared when they were read.

    Not where a number of an input is free, nor behind a filter of all.
    """
    return run.readings is not None and not structure.free_inputs and not structure.behind_filter


@dataclass(frozen=True, eq=False)
class Instants:
    """Times within a run, on its grid of pulses, and the commands as they were given.

    Parameters
    ----------
    run, record
        The run, and its pulses.
    structure
        Whose delays are honoured.
    readings
        Rows of the run at times of their own.
    times
        The times [s since the first row].
    """

    run: Run
    record: Record
    structure: Structure
    readings: Readings
    times: Floats

    @classmethod
    def of(cls, run: Run, record: Record, structure: Structure, times: Floats) -> Instants:
        """At some times of a run; a regular one was read on its grid."""
        run = acting(run, structure)
        readings = run.readings or Readings(run.time, {n: run[n] for n in run.signals})
        return cls(run, record, structure, readings, times)

    @property
    def places(self) -> Floats:
        """The times in pulses."""
        return np.asarray(np.minimum(self.times / self.record.step, float(self.record.m)))

    def jumps(self, name: str) -> tuple[Floats, Floats] | None:
        """Places and sizes of the jumps of an input that holds in between; None for what does not jump."""
        if name not in self.run.inputs or self.run.intersample[name] != HELD:
            return None
        times, sizes = self.readings.jumps(name, self._delay(name), self._before(name))
        return np.asarray(times / self.record.step), sizes

    def values(self, name: str) -> Floats | None:
        """A signal at the times, after it has changed there; None for one that is made of others."""
        if name in self.run.inputs:
            kind = self.run.intersample[name]
            return self.readings.at(name, kind, self.times, self._delay(name), self._before(name))
        if name not in self.run:
            return None
        return self.readings.at(name, "foh", self.times, 0.0, 0.0)

    def corners(self, name: str, order: float) -> Floats | None:
        """What the pulses lack at the times of I^order of an input that jumps."""
        jumps = self.jumps(name)
        if jumps is None:
            return None
        return _core.corners(self.record.m, self.places, jumps, order, self.record.step)

    def _delay(self, name: str) -> float:
        return self.structure.delay.get(name, 0.0)

    def _before(self, name: str) -> float:
        return 0.0 if self.record.initial == "rest" else float(self.readings.data[name][0])


def compared_times(run: Run, structure: Structure) -> Floats:
    """When the samples of a run that are compared were read [s since its first row]."""
    if run.readings is None or not has_own_times(run, structure):
        return run.time
    return run.readings.times[run.readings.compared(run.duration)]


def compared_values(run: Run, structure: Structure, name: str) -> Floats:
    """A signal at these times, as it was recorded; an output is NaN where it was not read."""
    if run.readings is None or not has_own_times(run, structure):
        return run[name]
    return run.readings.data[name][run.readings.compared(run.duration)]
