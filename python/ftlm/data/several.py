"""One run or several: checked once at the door."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ftlm.base.checks import listed
from ftlm.base.errors import DataError
from ftlm.data.run import Run


def check_compatible(runs: Iterable[Run]) -> None:
    """Raise unless all runs have the same inputs, outputs and units.

    Steps, lengths, intersample behaviour and the order of the signals may differ.

    Parameters
    ----------
    runs : iterable of Run
        At least one.

    Raises
    ------
    DataError
        If there is no run, or names or units differ; the run and the signal are named.
    """
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


def as_runs(runs: Run | Sequence[Run]) -> list[Run]:
    """One run or several as a list.

    Raises
    ------
    DataError
        No run, something that is no run, or runs whose names or units differ.
    """
    try:
        found = [runs] if isinstance(runs, Run) else list(runs)
    except TypeError:
        raise DataError(f"runs is {type(runs).__name__}; give a Run or a list of them") from None
    if not found:
        raise DataError("no run is given; give at least one")
    for i, run in enumerate(found):
        if not isinstance(run, Run):
            raise DataError(f"runs[{i}] is {type(run).__name__}, not a Run; use ftlm.load or Run.from_arrays")
    check_compatible(found)
    return found
