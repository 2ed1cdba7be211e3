"""The command that tells whether parts of a run, or several runs, are one model: agreement."""

from __future__ import annotations

from typing import Annotated, Literal

from typer import Option

from ftlm.base.output import COMMAND, check_free
from ftlm.base.pace import between
from ftlm.base.progress import Progress
from ftlm.cli.command import command, show
from ftlm.cli.identify import fit_seconds
from ftlm.cli.options import Files, Force, Json, ReadingOptions, StructureOptions, StructureText, Text, Threads
from ftlm.identification import agreement as parts_of_runs


@command
def agreement(
    *, files: Files, structure: StructureText, reading: ReadingOptions, shape: StructureOptions,
    parts: Annotated[
        int | None, Option(help="Parts that one run is cut into, by default 2; several runs are parts by themselves.")
    ] = None,
    loss: Annotated[
        Literal["squares", "huber"] | None, Option(help="huber, so that outliers decide nothing; default squares.")
    ] = None,
    threads: Threads = None,
    report: Annotated[Text, Option(metavar="HTML", help="Page to write.")] = None,
    force: Force = False, as_json: Json = False,
) -> None:  # fmt: skip
    """Identify parts of a run each by itself, and tell which numbers of which parts are not one model's."""
    check_free(report, force=force, words=COMMAND)
    shape.structure(structure)
    runs = reading.runs(files)
    wanted = shape.measured(structure, runs)
    with Progress("fitting parts", quiet=as_json) as progress:
        count = max(parts or 0, 2) if len(runs) == 1 else len(runs)
        progress.expect("fitting all parts", *between(fit_seconds(runs, wanted, threads, count)))
        found = parts_of_runs.agreement(runs, wanted, parts=parts, loss=loss, threads=threads, progress=progress)
    if report is not None:
        found.report(report, force=force)
    show(found, as_json=as_json)
