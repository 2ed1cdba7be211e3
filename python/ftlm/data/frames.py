"""Frames of pandas and polars and datasets of xarray, into runs and out of them."""

from __future__ import annotations

import importlib
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, cast

from ftlm.base.checks import listed, names_to_columns, nearest
from ftlm.base.errors import DataError, ModelError
from ftlm.data.asked import Asked
from ftlm.data.measured import Measured
from ftlm.data.names import CSV_TIME
from ftlm.data.samples import as_seconds
from ftlm.data.units import is_time_name, time_unit_of


def asked_of_frame(
    frame: object, *, time: Hashable | None, step: float | None, inputs: object, outputs: object,
    time_unit: str | None, window: Sequence[float | None] | None, **more: Any,
) -> Asked:  # fmt: skip
    """Take columns of a frame; see :meth:`ftlm.Run.from_frame`."""
    columns, index = _columns_of(frame), _index_of(frame)

    def pick(column: Hashable, thing: str) -> object:
        count = columns.count(column)
        if count == 0 and index is not None and column == index[0]:
            return index[1]
        if count == 0:
            raise DataError(
                f"column {column!r} ({thing}) is not in the frame{nearest(column, columns)}; "
                f"the columns are {listed(columns)}; for the index of a pandas frame use frame.reset_index()"
            )
        if count > 1:
            raise DataError(f"column {column!r} ({thing}) is there {count} times; rename all but one")
        return cast("Mapping[Any, object]", frame)[column]

    label, clock = "time" if time is None else f"time (column {time!r})", None
    if time is not None:
        clock = pick(time, "time")
    elif step is None and index is not None and _is_clock(*index):
        time, clock = index
        label = "time (the index)" if time is None else f"time (the index {time!r})"
    wanted = [names_to_columns(argument, given) for argument, given in (("inputs", inputs), ("outputs", outputs))]
    labels = {s: f"signal {s!r} (column {column!r})" for part in wanted for s, column in part.items()}
    given_inputs, given_outputs = ({s: pick(c, f"signal {s!r}") for s, c in part.items()} for part in wanted)
    if isinstance(time, str):
        unit, said = time_unit_of(time, label, time_unit)
    else:
        unit, said = time_unit or "s", ()
    return Asked(
        given_inputs, given_outputs, step=step, time=clock, time_unit=unit, window=window, labels=labels, facts=said,
        time_label=label, **more,
    )  # fmt: skip


def _columns_of(frame: object) -> list[Hashable]:
    if isinstance(frame, Mapping):
        # Of a dataset of xarray, too, whose coordinates are columns like the others.
        return list(getattr(frame, "variables", frame))
    # A lazy polars frame is told by its collect(); asking it for its columns would already start work.
    columns = None if hasattr(frame, "collect") else getattr(frame, "columns", None)
    if columns is None:
        columns = getattr(getattr(frame, "dtype", None), "names", None)
    if columns is None or not hasattr(frame, "__getitem__"):
        raise DataError(
            f"frame is a {type(frame).__name__}; pass a pandas or polars DataFrame (collect() a lazy one first), "
            "a dict of arrays or a structured array"
        )
    return list(columns)


def _index_of(frame: object) -> tuple[Hashable, object] | None:
    """Name and values of what the rows of a frame are known by; None where there is no such thing, or several."""
    sizes = getattr(frame, "sizes", None)
    if isinstance(frame, Mapping) and isinstance(sizes, Mapping):
        only = next(iter(sizes), None)
        return (only, cast("Any", frame)[only]) if len(sizes) == 1 and only in getattr(frame, "coords", ()) else None
    index = getattr(frame, "index", None)
    if index is None or callable(index) or getattr(index, "nlevels", 1) != 1:
        return None
    return getattr(index, "name", None), index


def _is_clock(name: Hashable, values: object) -> bool:
    """Whether an index is the time: it holds dates, or is called so."""
    return (isinstance(name, str) and is_time_name(name)) or as_seconds(values, "time (the index)") is not None


def frame_of(run: Measured) -> Any:
    """Return a run as a pandas frame over its time."""
    pandas = _library("pandas")
    index = pandas.Index(run.start + run.time, name=CSV_TIME)
    frame = pandas.DataFrame({name: run[name].copy() for name in run.signals}, index=index)
    frame.attrs = {**_told(run), "units": run.units, "intersample": dict(run.intersample)}
    return frame


def dataset_of(run: Measured) -> Any:
    """Return a run as an xarray dataset over its time."""
    xarray = _library("xarray")
    signals = {}
    for name in run.signals:
        role = {"role": "input", "intersample": run.intersample[name]} if name in run.inputs else {"role": "output"}
        signals[name] = (CSV_TIME, run[name].copy(), {"units": run.units[name], **role})
    clock = (CSV_TIME, run.start + run.time, {"units": "s"})
    return xarray.Dataset(signals, coords={CSV_TIME: clock}, attrs=_told(run))


def _told(run: Measured) -> dict[str, Any]:
    told = {"name": run.name, "inputs": list(run.inputs), "outputs": list(run.outputs), "step": run.step}
    return {**told, "warnings": list(run.warnings)}


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ModelError(f"{name} is not installed; pip install {name}") from None
