"""Command-line options for reading measured files."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

from ftlm.cli.framework import announce_reading, interval, pairs
from ftlm.data.run import Run
from ftlm.data.sampling import MissingPolicy
from ftlm.errors import DataError, ModelError
from ftlm.io.column_roles import ColumnSelection
from ftlm.io.dialect import Layout
from ftlm.io.load import LoadOptions, Signals, load_selection, run_paths, select_columns
from ftlm.io.preview import OpenedFile, preview_selection
from ftlm.structure.structure import Structure


def layout_options(record: object) -> dict[str, Any]:
    """Return the layout options that the user set, by name; `record` is a dataclass with options as fields."""
    options = {f.name: getattr(record, f.name, None) for f in fields(Layout)}
    return {name: value for name, value in options.items() if value is not None}


@dataclass(frozen=True)
class ReadingOptions:
    """Options for reading measured files; the value None marks an option that is not given.

    File
    ----
    time
        Time column; default found by its name.
    time_unit
        Unit of the time column; default its header's, or s.
    step
        Sampling interval [s] of files without a time column.
    inputs : NAME=COLUMN
        Input; NAME alone if the column has that name.
    outputs : NAME=COLUMN
        Output; NAME alone if the column has that name.
    units : NAME=UNIT
        Unit of a signal, such as deg.
    columns : TOML
        File that names columns and units.
    intersample : NAME=zoh|foh
        Hold of an input between samples; default zoh.
    window : FROM:TO
        Part of the run, in seconds [s] since its first row.
    resample : STEP
        Resample irregular rows to this step [s].
    missing
        Missing values: weight omits outputs; hold repeats inputs.
    encoding
        Text encoding, such as cp1252; default detected.
    dates
        Order of day and month in ambiguous dates.
    detrend
        Subtract the mean or a straight line from every signal.
    """

    time: str | None = None
    time_unit: Literal["s", "ms", "us", "min", "h"] | None = None
    step: float | None = None
    inputs: list[str] | None = None
    outputs: list[str] | None = None
    units: list[str] | None = None
    columns: str | None = None
    intersample: list[str] | None = None
    window: str | None = None
    resample: float | None = None
    missing: MissingPolicy | None = None
    encoding: str | None = None
    separator: Literal["comma", "semicolon", "tab", "space"] | None = None
    decimal: Literal["point", "comma"] | None = None
    thousands: Literal["none", "point", "comma", "space", "apostrophe"] | None = None
    skip: int | None = None
    header: int | None = None
    dates: Literal["ymd", "dmy", "mdy"] | None = None
    sheet: str | None = None
    detrend: Literal["constant", "linear"] | None = None

    def runs(
        self, files: Sequence[str] | None, structure: Structure | None = None, *, apart: bool = False
    ) -> list[Run]:
        """Return the runs in files, detrended if requested; [] without files.

        Each group of an HDF5 file that has a time column is a run. Several .mat files with one signal each form one
        run, unless `apart` is True. Signals of `structure` that no option assigns are read from the columns of the same
        name.
        """
        runs = self._read(files, structure, apart=apart)
        return runs if self.detrend is None else [run.detrend(self.detrend) for run in runs]

    def _read(self, files: Sequence[str] | None, structure: Structure | None, *, apart: bool) -> list[Run]:
        if not files:
            return []
        announce_reading(files)
        signals: Signals | None = None
        if structure is not None:
            signals = [s for s in structure.signals if s not in structure.outputs], structure.outputs
        if not apart and len(files) > 1 and all(f.lower().endswith(".mat") for f in files):
            try:
                self._load(files[0], signals)
            except DataError:
                # The first file alone lacks a requested column, so the files are read as one run.
                run = self._load(list(files), signals)
                print(f"ftlm: {len(files)} .mat files read as one run", file=sys.stderr)
                return [run]
        # Column names that include the path of their group already select a single run.
        has_paths = any("/" in text for text in (*(self.inputs or ()), *(self.outputs or ()), self.time or ""))
        paths = files if has_paths else [path for file in files for path in run_paths(file)]
        return [self._load(path, signals) for path in paths]

    def _load(self, path: str | list[str], signals: Signals | None) -> Run:
        return load_selection(path, *self._selection(), signals)

    def _selection(self) -> tuple[ColumnSelection, LoadOptions]:
        """Return the column selection with the layout, and the further options for loading.

        Raise ModelError for an invalid option.
        """
        selection = select_columns(
            self.columns,
            self.time,
            self.step,
            pairs("-u", self.inputs),
            pairs("-y", self.outputs),
            pairs("--units", self.units),
            pairs("--intersample", self.intersample),
            layout_options(self),
        )
        window = None if self.window is None else interval(self.window, "--window", "1.1:19.5")
        return selection, LoadOptions(window, self.resample, None, self.time_unit, self.missing)

    def preview_file(self, file: str) -> OpenedFile:
        """Return the preview of a file without loading it as a run; raise ModelError for the option --detrend."""
        if self.detrend is not None:
            raise ModelError("--detrend is not used with open; give it to the command that loads the file next")
        announce_reading([file])
        return preview_selection(file, *self._selection())


def given_fields(*records: Any) -> dict[str, Any]:
    """Return the options that the user set, by name: the fields of the given dataclasses that are not None."""
    return {
        f.name: getattr(record, f.name)
        for record in records
        for f in fields(record)
        if getattr(record, f.name) is not None
    }
