"""The command that chooses a structure: select."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from typer import Option

from ftlm.base.errors import ModelError
from ftlm.base.output import COMMAND, check_free
from ftlm.base.progress import Progress
from ftlm.cli.command import command, show
from ftlm.cli.options import CandidateTexts, Files, Force, Json, Out, ReadingOptions, StructureOptions, Text, Threads
from ftlm.data.structures import Structure
from ftlm.selection import select as choice


@command
def select(
    *, files: Files, structures: CandidateTexts, reading: ReadingOptions, shape: StructureOptions,
    by: Annotated[
        Text, Option("--by", metavar="runs|blocks", help="Judge each run, or each quarter of a run, by the others.")
    ] = None,
    validation: Annotated[
        Text, Option(metavar="FILE", help="Judge by this run instead; nothing is fitted to it.")
    ] = None,
    threads: Threads = None, out: Out = None,
    report: Annotated[Text, Option(metavar="HTML", help="Page to write.")] = None,
    force: Force = False, as_json: Json = False,
) -> None:  # fmt: skip
    """Choose the terms and orders that earn their place on what they were not fitted to."""
    check_free(out, report, force=force, words=COMMAND)
    if by is not None and validation is not None:
        raise ModelError(f"--by {by} and --validation {validation} both say what judges; leave one out")
    if "auto" in structures and len(structures) > 1:
        raise ModelError("--structure auto is searched by itself; leave the others out, or give them without it")
    if structures == ["auto"]:
        given = shape.given()
        if given:
            raise ModelError(f"{', '.join(given)}: of a structure that is given, not used with --structure auto")
        candidates: str | Structure | list[Structure] = "auto"
    else:
        made = [shape.structure(text) for text in structures]
        candidates = made[0] if len(made) == 1 else made
    runs = reading.runs(files)
    # The slice is of the runs that are fitted to.
    judges = replace(reading, sliced=None).runs([validation]) if validation is not None else by
    with Progress("fitting candidates", quiet=as_json) as progress:
        found = choice.select(runs, candidates, validation=judges, threads=threads, progress=progress)
    if out is not None:
        found.best.model.save(out, force=force)
    if report is not None:
        found.report(report, force=force)
    show(found, as_json=as_json)
