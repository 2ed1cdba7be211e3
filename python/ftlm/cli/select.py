"""The command that chooses a structure: select."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from typer import Option

from ftlm.base.errors import ModelError
from ftlm.base.output import COMMAND, check_free
from ftlm.base.progress import Progress
from ftlm.cli.command import command, show
from ftlm.cli.identify import fit_seconds, resumable
from ftlm.cli.options import CandidateTexts, Files, Force, Json, Out, ReadingOptions, StructureOptions, Text, Threads
from ftlm.data.structures import Structure
from ftlm.selection import select as choice


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
        tried = [candidates] if isinstance(candidates, (str, Structure)) else candidates
        whole = max((fit_seconds(runs, one, threads) for one in tried if isinstance(one, Structure)), default=0.0)
        # How many candidates come up turns with what earns its place; they are counted as they do.
        progress.expect("the largest candidate alone", whole)
        if candidates == "auto":
            progress.say("candidates come up as others are fitted; --structure auto takes minutes, and Ctrl-C ends it")
        found = choice.select(runs, candidates, validation=judges, threads=threads, progress=progress, store=store)
    if out is not None:
        found.best.model.save(out, force=force)
    if report is not None:
        found.report(report, force=force)
    show(found, as_json=as_json)
