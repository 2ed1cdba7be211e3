"""One run or several: checked once at the door."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from ftlm.base.checks import listed
from ftlm.base.errors import DataError
from ftlm.data.run import Run

#: Results that are kept with runs: those of the equations one by one and of the whole.
MOST_KEPT = 8


def check_compatible(runs: Iterable[Run]) -> None:
    """Refuse runs whose inputs, outputs or units differ; steps, lengths, holds and the order of signals may."""
    every = list(runs)
    if not every:
        raise DataError("runs: there is none; pass at least one run")
    first = every[0]
    for index, run in enumerate(every[1:], start=1):
        who = f"run {index} ({run.name!r}) and run 0 ({first.name!r})"
        for role, mine, other in (("inputs", first.inputs, run.inputs), ("outputs", first.outputs, run.outputs)):
            if set(mine) != set(other):
                raise DataError(
                    f"{who} have different {role}: {listed(other)} and {listed(mine)}; "
                    "use rename() and select() so that the names agree"
                )
        units, first_units = run.units, first.units
        differing = [name for name in first.signals if units[name] != first_units[name]]
        if differing:
            name = differing[0]
            raise DataError(
                f"{who} have different units: signal {name!r} is in {units[name]!r} and {first_units[name]!r}, "
                f"{len(differing)} in all; give the same units= when loading"
            )


class Runs(tuple[Run, ...]):
    """Runs that fit together, checked once; see :func:`as_runs`.

    What is computed from them time and again stays with them, read-only, and goes when they go.
    """

    _kept: dict[str, tuple[Any, ...]]

    def __new__(cls, runs: Run | Iterable[Run]) -> Runs:
        """Check them."""
        try:
            every = [runs] if isinstance(runs, Run) else list(runs)
        except TypeError:
            raise DataError(f"runs is {type(runs).__name__}; give a Run or a list of them") from None
        if not every:
            raise DataError("no run is given; give at least one")
        for i, run in enumerate(every):
            if not isinstance(run, Run):
                raise DataError(f"runs[{i}] is {type(run).__name__}, not a Run; use ftlm.load or Run.from_arrays")
        check_compatible(every)
        checked = super().__new__(cls, every)
        checked._kept = {}
        return checked

    def __reduce__(self) -> tuple[object, ...]:
        return Runs, (tuple(self),)

    def keep(self, key: str, make: Callable[[], Iterable[Any]]) -> tuple[Any, ...]:
        """Return what was made under this key, or make it; the oldest goes where there are too many."""
        made = self._kept.get(key)
        if made is None:
            made = self._kept[key] = tuple(make())
            for old in list(self._kept)[:-MOST_KEPT]:
                self._kept.pop(old, None)
        return made


def as_runs(runs: Run | Iterable[Run]) -> Runs:
    """One run or several that fit together; what is checked passes untouched.

    Raises
    ------
    DataError
        No run, something that is no run, or runs whose names or units differ.
    """
    return runs if isinstance(runs, Runs) else Runs(runs)
