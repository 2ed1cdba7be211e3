"""The file that keeps what an experiment has recorded so far."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.errors import DataError, RigFault
from ftlm.data.header import Header
from ftlm.data.names import CSV_TIME
from ftlm.data.run import Run
from ftlm.rig.excitation import INPUTS
from ftlm.rig.rig import COLUMNS

UNITS = {name: "A" if name.startswith("I") else "rad" for name in COLUMNS}


def units_of(told: tuple[str, ...] = ()) -> dict[str, str]:
    """Units of a run's columns; what a run tells besides are angles."""
    return UNITS | dict.fromkeys(told, "rad")


def partial_of(target: Path) -> Path:
    """Where the rows of a run are until it has ended."""
    return target.with_name(target.stem + ".csv.partial")


class Partial:
    """Rows on disk while they come: a csv file beside the one asked for, which loads should the program die.

    Parameters
    ----------
    target
        The file asked for; None keeps nothing on disk.
    name, step, about
        Of the run.
    told
        Names of its further inputs, which follow the rig's columns in every row.
    """

    def __init__(
        self, target: Path | None, name: str, step: float, about: dict[str, Any], told: tuple[str, ...] = ()
    ) -> None:
        self.path = None if target is None else partial_of(target)
        self._step, self._rows = step, 0
        self._columns = (*COLUMNS, *told)
        #: Rows that are on disk, whole.
        self.kept = 0
        self._descriptor: int | None = None
        if self.path is None:
            return
        inputs = (*INPUTS, *told)
        header = Header(
            name, step, 0.0, inputs, tuple(COLUMNS[2:]), units_of(told), dict.fromkeys(inputs, "zoh"),
            ("the recording did not end: the program died, or the disk was full",),
            about | {"faults": ["the recording did not end"]},
        )  # fmt: skip
        lines = f"{header.line()}{','.join([CSV_TIME, *self._columns])}\n"
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        try:
            # Whoever overwrites a link means the link, not what it leads to.
            self.path.unlink(missing_ok=True)
            self._descriptor = os.open(self.path, flags, 0o666)
            self._append(lines.encode())
        except OSError as error:
            self.close()
            reason = error.strerror or error
            raise DataError(
                f"{str(self.path)!r} cannot be written ({reason}); check the folder and the space left"
            ) from None

    def write(self, rows: Floats) -> None:
        """Appends rows, shape (n, columns).

        Raises
        ------
        RigFault
            They cannot be written; whole rows stay.
        """
        if self._descriptor is None or len(rows) == 0:
            self._rows += len(rows)
            return
        t = np.round((self._rows + np.arange(len(rows))) * self._step, 9)
        columns = [map(repr, t.tolist()), *(map(repr, rows[:, k].tolist()) for k in range(len(self._columns)))]
        text = "\n".join(map(",".join, zip(*columns, strict=True))) + "\n"
        self._rows += len(rows)
        try:
            self._append(text.encode())
            self.kept += len(rows)
        except OSError as error:
            raise RigFault(f"the recording cannot be written to disk ({error.strerror or error}); make space") from None

    def _append(self, content: bytes) -> None:
        if self._descriptor is None:
            return
        whole = os.lseek(self._descriptor, 0, os.SEEK_END)
        try:
            while content:
                content = content[os.write(self._descriptor, content) :]
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, whole)
            raise

    def close(self) -> None:
        """Closes the file."""
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                os.close(self._descriptor)
            self._descriptor = None

    def remove(self) -> None:
        """Closes and removes it: the run is in its own file."""
        self.close()
        if self.path is not None:
            with contextlib.suppress(OSError):
                self.path.unlink()


def saved(
    run: Run | None, target: Path | None, partial: Partial, *, force: bool, ended: BaseException | None,
    faults: list[str],
) -> Run:  # fmt: skip
    """Write the run, and raise what ended it."""
    place = "nothing was recorded until then"
    if run is not None:
        place = f"{run.length} rows were recorded until then"
        if target is not None:
            try:
                save = run.to_csv if target.suffix.lower() == ".csv" else run.to_parquet
                save(target, force=force)
                partial.remove()
                place += f" and are in {target}"
            except DataError as error:
                partial.close()
                place += f"; {partial.kept} of them are in {partial.path}"
                fault = RigFault(f"{error}; {place}")
                if ended is not None:
                    fault = RigFault(f"{'; '.join(faults)}; {place}")
                fault.run = run
                raise fault from None
    else:
        partial.remove()
    if ended is not None and not isinstance(ended, RigFault):
        raise ended
    if ended is not None or faults or run is None:
        fault = RigFault(f"{'; '.join(faults) or 'no sample was read'}; {place}")
        fault.run = run
        # What made a controller fail is its own to show.
        raise fault from (None if ended is None else ended.__cause__)
    return run
