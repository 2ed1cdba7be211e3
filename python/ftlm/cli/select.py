"""The command that chooses a structure: select."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from typer import Option

from ftlm.base.errors import ModelError
from ftlm.base.output import COMMAND, check_free
from ftlm.base.pace import between
from ftlm.base.progress import Progress
from ftlm.cli.command import command, show
from ftlm.cli.identify import fit_seconds, resumable
from ftlm.cli.options import CandidateTexts, Files, Force, Json, Out, ReadingOptions, StructureOptions, Text, Threads
from ftlm.data.structures import Structure
from ftlm.selection import select as choice
from ftlm.selection.automatic import automatic

#: A choice from a list, and one inside structures, took between these multiples of what one fit of each of them takes.
LISTED, GROWN = (1.0, 8.0), (1.5, 20.0)


@command
def select(
    *, files: Files, structures: CandidateTexts, reading: ReadingOptions, shape: StructureOptions,
    validation: Annotated[
        Text,
        Option(
            metavar="runs|blocks|FILE",
            help="Judge each run, or each quarter of every run, by the others; or by a run that nothing is fitted to.",
        ),
    ] = None,
    threads: Threads = None,
    store: Annotated[
        Text, Option(metavar="FILE", help="Keep every fit there; the same command goes on with it.")
    ] = None,
    out: Out = None,
    report: Annotated[Text, Option(metavar="HTML", help="Page to write.")] = None,
    force: Force = False, as_json: Json = False,
) -> None:  # fmt: skip
    """Choose the terms and orders that earn their place on what they were not fitted to."""
    check_free(out, report, force=force, words=COMMAND)
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
    if structures != ["auto"]:
        made = [shape.measured(text, runs) for text in structures]
        candidates = made[0] if len(made) == 1 else made
    # The slice is of the runs that are fitted to.
    of_its_own = validation not in (None, "runs", "blocks")
    judges = replace(reading, sliced=None).runs([str(validation)]) if of_its_own else validation
    with resumable(store, "the same command"), Progress("fitting candidates", quiet=as_json) as progress:
        tried = [candidates] if isinstance(candidates, Structure) else candidates
        grown = automatic(runs) if isinstance(tried, str) else tried
        seconds = sum(fit_seconds(runs, one, threads) for one in grown)
        listed = isinstance(candidates, list)
        progress.expect("choosing", *between(seconds, LISTED if listed else GROWN))
        # How many candidates come up turns with what earns its place.
        told = progress if listed else progress.so_far
        found = choice.select(runs, candidates, validation=judges, threads=threads, progress=told, store=store)
    if out is not None:
        found.best.model.save(out, force=force)
    if report is not None:
        found.report(report, force=force)
    show(found, as_json=as_json)
