"""Sets of compatible runs, with a cache of results that are derived from them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from ftlm.data.run import Run
from ftlm.errors import DataError
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import join_names

#: Maximum number of cached results per set of runs, enough for each equation and the whole structure.
MAX_CACHED_RESULTS = 8


def check_compatible(runs: Iterable[Run]) -> None:
    """Raise DataError if there is no run, or if runs differ in inputs, outputs or units.

    Runs may differ in step, length, intersample behavior, and the sequence of their signals.
    """
    run_list = list(runs)
    if not run_list:
        raise DataError("runs: there is none; pass at least one run")
    first = run_list[0]
    for index, run in enumerate(run_list[1:], start=1):
        subject = f"run {index} ({run.name!r}) and run 0 ({first.name!r})"
        for role, first_names, other in (("inputs", first.inputs, run.inputs), ("outputs", first.outputs, run.outputs)):
            if set(first_names) != set(other):
                raise DataError(
                    f"{subject} have different {role}: {join_names(other)} and {join_names(first_names)}; "
                    "use rename() and select() so that the names agree"
                )
        units, first_units = run.units, first.units
        differing = [name for name in first.signals if units[name] != first_units[name]]
        if differing:
            name = differing[0]
            raise DataError(
                f"{subject} have different units: signal {name!r} is in {units[name]!r} and {first_units[name]!r}, "
                f"{len(differing)} in all; give the same {parameter('units')} when loading"
            )


class Runs(tuple[Run, ...]):
    """Tuple of compatible runs with a cache of derived results; :func:`as_runs` creates it."""

    _cache: dict[str, tuple[Any, ...]]

    def __new__(cls, runs: Run | Iterable[Run]) -> Runs:
        """Return the tuple of validated runs; raise DataError as :func:`as_runs` does."""
        try:
            run_list = [runs] if isinstance(runs, Run) else list(runs)
        except TypeError:
            raise DataError(
                f"runs is {type(runs).__name__}; give a Run or a list of them (identify_frequency takes frequency "
                "data: fit each circuit or equation, and compare their information.aicc)"
            ) from None
        if not run_list:
            raise DataError("no run is given; give at least one")
        for i, run in enumerate(run_list):
            if not isinstance(run, Run):
                raise DataError(f"runs[{i}] is {type(run).__name__}, not a Run; use ftlm.load or Run.from_arrays")
        check_compatible(run_list)
        checked = super().__new__(cls, run_list)
        checked._cache = {}
        return checked

    def __reduce__(self) -> tuple[object, ...]:
        return Runs, (tuple(self),)

    def get_or_compute(self, key: str, compute: Callable[[], Iterable[Any]]) -> tuple[Any, ...]:
        """Return the cached items for a key; if there are none, collect the items of ``compute()`` and cache them.

        The oldest result is removed when the cache is full.
        """
        entry = self._cache.get(key)
        if entry is None:
            entry = self._cache[key] = tuple(compute())
            for old in list(self._cache)[:-MAX_CACHED_RESULTS]:
                self._cache.pop(old, None)
        return entry


def as_runs(runs: Run | Iterable[Run]) -> Runs:
    """Return one or several runs as validated :class:`Runs`; an instance of :class:`Runs` is returned unchanged.

    Raises
    ------
    DataError
        If there is no run, an object is not a run, or runs have different signals or units.
    """
    return runs if isinstance(runs, Runs) else Runs(runs)
