"""Commands for data files: open and inspect."""

from __future__ import annotations

import json

from ftlm.cli.framework import OptionalOutputFile, command, print_text, print_written_files, show
from ftlm.cli.reading_options import ReadingOptions


@command
def open_(
    file: str,
    *,
    reading: ReadingOptions,
    write_columns: OptionalOutputFile = None,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Preview a file: print columns, units, roles, step, assumptions, and the command for the next step.

    Arguments
    ---------
    file : FILE
        Measured file.

    Output
    ------
    write_columns : TOML
        Write columns, units and layout to this file for --columns.
    """
    opened = reading.preview_file(file)
    if write_columns is not None:
        opened.write_columns(write_columns, force=force)
    show(opened, as_json=as_json)
    if not as_json:
        print_written_files(write_columns)


@command
def inspect(files: list[str], *, reading: ReadingOptions, as_json: bool = False) -> None:
    """Print range, noise, quantization and initial rest of the signals of runs, and advice before identification."""
    inspected = [(run.inspect(), run.advice()) for run in reading.runs(files)]
    if as_json:
        data = [{**figures.to_dict(), "advice": advice.to_dict()} for figures, advice in inspected]
        print(json.dumps(data, indent=1, ensure_ascii=False))
    else:
        print_text("\n\n".join(f"{figures}\n{advice}" for figures, advice in inspected))
