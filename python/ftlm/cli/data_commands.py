"""Commands for data: open, inspect."""

from __future__ import annotations

import json
from typing import Annotated

from typer import Argument

from ftlm.cli.framework import command, print_text, show
from ftlm.cli.reading_options import Files, Json, ReadingOptions


@command
def open_(
    *,
    file: Annotated[str, Argument(metavar="FILE", help="Measured file.")],
    reading: ReadingOptions,
    as_json: Json = False,
) -> None:
    """Preview a file: columns, units, roles, step, assumptions with contrary evidence, next command."""
    show(reading.preview_file(file), as_json=as_json)


@command
def inspect(*, files: Files, reading: ReadingOptions, as_json: Json = False) -> None:
    """Print ranges, noise, quantization and rest of runs, and advice before identification."""
    inspected = [(run.inspect(), run.advice()) for run in reading.runs(files)]
    if as_json:
        data = [{**figures.to_dict(), "advice": advice.to_dict()} for figures, advice in inspected]
        print(json.dumps(data, indent=1, ensure_ascii=False))
    else:
        print_text("\n\n".join(f"{figures}\n{advice}" for figures, advice in inspected))
