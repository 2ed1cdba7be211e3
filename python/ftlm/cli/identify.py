"""Commands that find a model in runs: identify, search, resume, status."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Argument, Option

from ftlm.base.checks import check_threads
from ftlm.base.errors import ModelError
from ftlm.base.output import COMMAND, check_free
from ftlm.base.pace import between, by_output_error, expected
from ftlm.base.progress import Progress
from ftlm.cli.command import EXIT_INTERRUPTED, command, say, show_json
from ftlm.cli.options import (
    Files,
    Force,
    GeneticOptions,
    Json,
    Number,
    Out,
    ReadingOptions,
    SearchOptions,
    StructureOptions,
    StructureText,
    Text,
    Threads,
    Verbose,
)  # fmt: skip
from ftlm.data.lattice import Lattice
from ftlm.data.run import Run
from ftlm.data.settings import check_used
from ftlm.data.structures import Structure
from ftlm.identification import identify as estimation
from ftlm.model.model import load_model
from ftlm.search.beforehand import announce
from ftlm.search.certificate import certify_job, check_certifiable
from ftlm.search.job import run_job
from ftlm.search.orders import job_of, make_job, resume_job, search_status
from ftlm.search.result import SearchResult
from ftlm.search.store import Store

Method = Literal["output-error", "instrumental-variables", "multi-innovation", "least-squares", "genetic"]
Estimator = Literal["instrumental-variables", "multi-innovation", "least-squares"]
StoreFile = Annotated[str, Argument(metavar="STORE", help="A file written with --store.")]


def fit_seconds(runs: Sequence[Run], structure: Structure, threads: int | None, fits: int = 1) -> float:
    """About how long fits by output error of all their numbers take here, the runs shared out among them [s]."""
    samples = sum(run.length for run in runs) * len(structure.outputs)
    numbers = len(structure.order_names) + len(structure.coefficient_names) + len(structure.free_inputs)
    return expected(fits * by_output_error(samples // max(fits, 1), numbers), check_threads(threads))


@command
def identify(
    *, files: Files, structure: StructureText,
    method: Annotated[Method, Option(help="How numbers are estimated.")] = "output-error",
    reading: ReadingOptions, shape: StructureOptions, search: SearchOptions, genetic: GeneticOptions,
    loss: Annotated[
        Literal["squares", "huber"] | None,
        Option(help="Of output error: huber, so that outliers decide nothing; default squares."),
    ] = None,
    intervals: Annotated[
        Literal["auto", "quadratic", "profile"] | None,
        Option(help="Of output error: by profile likelihood for all numbers, or (default) where it matters."),
    ] = None,
    start: Annotated[
        Text, Option(metavar="MODEL", help="Of output error: a saved model, simpler or not, to start from as well.")
    ] = None,
    threads: Threads = None,
    reference: Annotated[
        Text, Option(metavar="SIGNAL", help="What drives a closed loop from outside; also name it with -u.")
    ] = None,
    store: Annotated[
        Text, Option(metavar="FILE", help="Keep finished order searches there; the same command goes on.")
    ] = None,
    out: Out = None,
    report: Annotated[Text, Option(metavar="HTML", help="Page to write.")] = None,
    validation: Annotated[Text, Option(metavar="FILE", help="Another run, to judge the model on.")] = None,
    force: Force = False, verbose: Verbose = False, as_json: Json = False,
) -> None:  # fmt: skip
    """Identify a model: whether to trust it, its equations, numbers, gain and modes, its fit, and warnings in words."""
    check_free(out, report, force=force, words=COMMAND)
    shape.structure(structure)
    begin = None if start is None else load_model(start)
    runs = reading.runs(files)
    wanted = shape.measured(structure, runs)
    # The slice is of the runs that are identified from.
    others = replace(reading, sliced=None).runs([validation]) if validation is not None else []
    label = "fitting" if method == "output-error" else "searching orders"
    with resumable(store, "the same command"), Progress(label, quiet=as_json) as progress:
        if method == "output-error":
            progress.expect("the fit", *between(fit_seconds(runs, wanted, threads)))
        result = estimation.identify(
            runs, wanted, method=method, lattice=search.lattice(), **search.settings(),
            genetic=genetic.settings(method), threads=threads, progress=progress, store=store,
            loss=loss, intervals=intervals, reference=reference, start=begin,
        )  # fmt: skip
    if out is not None:
        result.model.save(out, force=force)
    if report is not None:
        progress.say("writing the report")
        result.report(report, validation=others or None, force=force)
    checked = result.validate(others) if others else None
    if as_json:
        judged = {"verdict": result.verdict(checked).to_dict()}
        show_json({**judged, **result.to_dict(), "validation": None if checked is None else checked.to_dict()})
        return
    # What Python has as a method, the command line has as an option.
    say(result.summary(checked).replace("print(result.details())", "--verbose shows all"))
    if verbose:
        say(f"\n{result.details()}")
    if verbose and checked is not None:
        say(f"\nvalidation on {', '.join(r.name for r in others)}\n{checked}")
    elif checked is not None:
        print(f"validation on {', '.join(r.name for r in others)}")
        say("\n".join(f"! {w}" for w in checked.warnings), end="\n" if checked.warnings else "")


@command
def search(
    *, files: Files, structure: StructureText,
    coefficients: Annotated[Estimator, Option(help="How coefficients are estimated.")] = "multi-innovation",
    reading: ReadingOptions, shape: StructureOptions, options: SearchOptions, threads: Threads = None,
    store: Annotated[Text, Option(metavar="FILE", help="Keep finished work there; go on with ftlm resume.")] = None,
    certify: Annotated[
        Number,
        Option(
            metavar="SHARE",
            help="Prove of orders between those of the lattice, too, that none is better by more than this share; of "
            "squared equation errors at rest.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:  # fmt: skip
    """Rank the orders of each equation, or of a stage under its order law, and account for every candidate."""
    shape.structure(structure)
    runs = reading.runs(files)
    wanted = shape.measured(structure, runs)
    parts = wanted.parts() or {e.output: wanted.equation(e.output) for e in wanted.equations}
    lattice = options.lattice() or Lattice()
    check_named(lattice, wanted)
    check_used(coefficients, options.settings(), argument="coefficients")
    results = {}
    with resumable(store), contextlib.ExitStack() as stack:
        jobs = {
            name: make_job(
                runs, part, lattice_of(lattice, part), coefficients=coefficients, threads=threads, **options.settings()
            )
            for name, part in parts.items()
        }
        if certify is not None:
            for job in jobs.values():
                check_certifiable(job, certify)
        kept = None
        if store is not None:
            kept = stack.enter_context(Store(store, [job.request(name) for name, job in jobs.items()]))
            show_notes(kept)
        announce(Progress("", quiet=as_json), list(jobs.values()), kept)
        for number, (name, job) in enumerate(jobs.items()):
            with Progress(f"searching orders of {name}", quiet=as_json) as progress:
                results[name] = run_job(replace(job, progress=progress), store=kept, number=number)
            if certify is not None:
                with Progress(f"proving what lies between of {name}", quiet=as_json) as progress:
                    proved = certify_job(job, within=certify, apart=lattice.step, progress=progress.so_far)
                results[name] = replace(results[name], certificate=proved)
    show_searches(results, as_json=as_json)


def check_named(lattice: Lattice, structure: Structure) -> None:
    """Refuse values of an order that is not free in any equation."""
    for name in lattice.orders:
        if name not in {"alpha", *structure.order_names}:
            free = ", ".join(structure.order_names) or "none"
            raise ModelError(f"--lattice {name!r} is no free order; free are {free}")


def lattice_of(lattice: Lattice, part: Structure) -> Lattice:
    """What a lattice says of the orders of one part."""
    return replace(lattice, orders={n: v for n, v in lattice.orders.items() if n == "alpha" or n in part.order_names})


def show_searches(results: Mapping[str, SearchResult], *, as_json: bool) -> None:
    """Searches by output, for people or as JSON."""
    if as_json:
        show_json({name: result.to_dict() for name, result in results.items()})
    else:
        say("\n\n".join(f"{name}\n{result}" for name, result in results.items()))


@contextlib.contextmanager
def resumable(path: str | None, how: str | None = None) -> Iterator[None]:
    """Say after Ctrl-C how to go on with a store, if there is one."""
    try:
        yield
    except KeyboardInterrupt:
        if path is None or not Path(path).exists():
            raise
        print(f"ftlm: interrupted; go on with: {how or f'ftlm resume {path}'}", file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED) from None


def show_notes(store: Store) -> None:
    """What was mended in a store."""
    for note in store.notes:
        print(f"ftlm: {store.path}: {note}", file=sys.stderr)


@command
def resume(
    *, store: StoreFile,
    salvage: Annotated[
        bool, Option("--salvage", help="Go on with a damaged store; the damaged file is kept beside it.")
    ] = False,
    threads: Threads = None, as_json: Json = False,
) -> None:  # fmt: skip
    """Go on with the searches of a store, and show them; it needs no other file."""
    results = {}
    with resumable(store), Store(store, salvage=salvage) as kept:
        show_notes(kept)
        told = Progress("", quiet=as_json)
        if not told.quiet:
            announce(told, [job_of(kept, n, threads) for n in range(len(kept.contents.requests))], kept)
        for number, request in enumerate(kept.contents.requests):
            with Progress(f"searching orders of {request.name}", quiet=as_json) as progress:
                results[request.name] = resume_job(kept, number, threads=threads, progress=progress)
    show_searches(results, as_json=as_json)


@command
def status(*, store: StoreFile, as_json: Json = False) -> None:
    """Show how far the searches of a store are; it may be in use."""
    states = search_status(store)
    if as_json:
        show_json({name: state.to_dict() for name, state in states.items()})
    else:
        print("\n".join(str(state) for state in states.values()))
