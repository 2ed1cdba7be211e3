"""Commands for data: open, inspect."""

from __future__ import annotations

import json
from typing import Annotated

from typer import Argument

from ftlm.cli.framework import command, output_file, print_text, say_written, show
from ftlm.cli.reading_options import OUTPUT_PANEL, Files, Force, Json, ReadingOptions, Text


@command
def open_(
    *,
    file: Annotated[str, Argument(metavar="FILE", help="Measured file.")],
    reading: ReadingOptions,
    write_columns: Annotated[
        Text,
        output_file(
            "Write columns, units and layout to this file for --columns.",
            "--write-columns",
            metavar="TOML",
            panel=OUTPUT_PANEL,
        ),
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Preview a file: columns, units, roles, step, assumptions with contrary evidence, next command."""
    opened = reading.preview_file(file)
    if write_columns is not None:
        opened.write_columns(write_columns, force=force)
    show(opened, as_json=as_json)
    if not as_json:
        say_written(write_columns)


@command
def inspect(*, files: Files, reading: ReadingOptions, as_json: Json = False) -> None:
    """Print ranges, noise, quantization and rest of runs, and advice before identification."""
    inspected = [(run.inspect(), run.advice()) for run in reading.runs(files)]
    if as_json:
        data = [{**figures.to_dict(), "advice": advice.to_dict()} for figures, advice in inspected]
        print(json.dumps(data, indent=1, ensure_ascii=False))
    else:
        print_text("\n\n".join(f"{figures}\n{advice}" for figures, advice in inspected))
