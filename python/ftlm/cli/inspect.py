"""Commands that look first: at a file (`open`), at a run (`inspect`), at the installation (`doctor`)."""

from __future__ import annotations

import json
import platform
from importlib import metadata
from typing import Annotated, Any

from typer import Argument

from ftlm import _core
from ftlm.base.checks import available_threads
from ftlm.cli.command import command, say, show
from ftlm.cli.options import Files, Json, ReadingOptions
from ftlm.data.inspection import inspect_run
from ftlm.rig.quanser import driver_state

#: What reads which files, and the extra that installs it.
_READERS = {
    "scipy": (".mat files", "mat"), "h5py": (".mat files of version 7.3 and HDF5", "hdf5"),
    "pyarrow": ("parquet and feather", "parquet"), "python-calamine": ("xlsx and ods", "excel"),
}  # fmt: skip


@command
def open_(
    *, file: Annotated[str, Argument(metavar="FILE", help="Any measured file.")], reading: ReadingOptions,
    as_json: Json = False,
) -> None:  # fmt: skip
    """Say what a file is: columns, units, roles, step, what was assumed and what says otherwise, what to type next."""
    show(reading.opened(file), as_json=as_json)


@command
def inspect(*, files: Files, reading: ReadingOptions, as_json: Json = False) -> None:
    """Show what a run holds: ranges, noise, quantisation, rest, and what to do about it before identification."""
    inspected = [(inspect_run(run), run.advice()) for run in reading.runs(files)]
    if as_json:
        data = [{**figures.to_dict(), "advice": advice.to_dict()} for figures, advice in inspected]
        print(json.dumps(data, indent=1, ensure_ascii=False))
    else:
        say("\n\n".join(f"{figures}\n{advice}" for figures, advice in inspected))


@command
def doctor(*, as_json: Json = False) -> None:
    """Show versions, cores, vector unit, and whether the rig's driver is there."""
    about: dict[str, Any] = {
        "ftlm": _core.__version__,
        "core": _core.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cores": available_threads(),
        "simd": _core.SIMD,
        "numpy": _installed("numpy"),
        **{package: _installed(package) for package in _READERS},
        "rig driver": driver_state(),
    }
    if as_json:
        print(json.dumps(about, indent=1))
        return
    for name, value in about.items():
        print(f"{name:<17}{value if value is not None else 'not installed'}")
    for package, (files, extra) in _READERS.items():
        if about[package] is None:
            print(f"{package} is needed for {files}: pip install 'ftlm[{extra}]'")


def _installed(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
