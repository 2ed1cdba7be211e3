"""Commands app, demo, reproduce and orders."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from ftlm.app.server import DEFAULT_PORT, serve
from ftlm.cli.framework import command, print_text, show_json
from ftlm.cli.options import GeneticOptions, GridIncrement, Page, Threads, Verbose
from ftlm.cli.reading_options import Files, Force, Json, ReadingOptions, Text, Texts, given_fields
from ftlm.errors import ModelError
from ftlm.estimation.genetic import GeneticAlgorithm
from ftlm.progress import Progress
from ftlm.reproduction import reproduction
from ftlm.reproduction.cross_validation import cross_validate_orders, cross_validation_page, cross_validation_text
from ftlm.reproduction.demo import demo_details, demo_page, demo_text, run_demo
from ftlm.reproduction.report import reproduction_text
from ftlm.reproduction.reproduction import ALWAYS_SAVED
from ftlm.reproduction.stage_result import CONTEST_STEP
from ftlm.utils.files import check_folder
from ftlm.utils.resources import estimate_duration
from ftlm.utils.validation import check_threads

#: Processor time of `ftlm demo` and its pages on the reference machine of base/pace.py [s].
DEMO_SECONDS = 22.0


@command
def demo(
    *,
    out: Annotated[str, Option("-o", "--out", metavar="FOLDER", help="Folder to write to.")] = "ftlm-demo",
    increment: GridIncrement = 0.1,
    noise: Annotated[float, Option(help="Noise on every angle [rad].")] = 1e-4,
    seed: Annotated[int, Option(min=0, help="Seed of the noise.")] = 1,
    threads: Threads = None,
    force: Force = False,
    verbose: Verbose = False,
    as_json: Json = False,
) -> None:
    """Simulate both stages, identify every equation with p = 1, 3, 5, 7, and write models, tables and charts.

    The paper's order grid has the increment 0.05, which takes minutes.
    """
    with Progress("", quiet=as_json) as progress:
        progress.expect("the demo", estimate_duration(DEMO_SECONDS * (0.1 / increment) ** 2, check_threads(threads)))
        result = run_demo(
            Path(out),
            increment=increment,
            noise=noise,
            seed=seed,
            threads=threads,
            force=force,
            log=progress.name,
            progress=progress,
        )
        result.files.append(demo_page(result, Path(out) / "demo.html", force=force))
    if as_json:
        show_json(result.to_dict())
    else:
        if verbose:
            print_text(f"{demo_details(result)}\n")
        files = f"{Path(out) / 'demo.html'} (open it), and {len(result.files) - 1} runs and models"
        print_text(f"{demo_text(result)}\nwritten: {files}")


@command
def reproduce(
    *,
    out: Page = "paper.html",
    save: Annotated[Text, Option(metavar="FOLDER", help="Also write runs, models and tables to this folder.")] = None,
    square: Annotated[Text, Option(metavar="FILE", help="Measured run to identify from.")] = None,
    sine: Annotated[Text, Option(metavar="FILE", help="Measured run to validate on.")] = None,
    reading: ReadingOptions,
    increment: GridIncrement = 0.05,
    noise: Annotated[float, Option(help="Noise on every angle of the virtual rig [rad].")] = 1e-4,
    seed: Annotated[int, Option(min=0, help="Seed of that noise.")] = 1,
    arms: Annotated[
        Texts, Option("--arms", metavar="ARM", help="Simulated arm for the verdicts; several, or all.")
    ] = None,
    records: Annotated[int, Option(min=1, help="Records per arm, with different noise.")] = 3,
    rivals_increment: Annotated[float, Option(help="Smallest increment in the comparison with the GA.")] = CONTEST_STEP,
    genetic: GeneticOptions,
    threads: Threads = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Recompute the tables and figures of the paper on simulated or measured runs, as one HTML page."""
    if save is not None:
        check_folder(Path(save), ALWAYS_SAVED, force=force)
    if sine is not None and square is None:
        raise ModelError("--sine is given without --square; give both, or neither for the virtual rig")
    measured = reading.runs([f for f in (square, sine) if f is not None], apart=True)
    rival = given_fields(genetic)
    with Progress("", quiet=as_json) as progress:
        result = reproduction.reproduce(
            *measured,
            increment=increment,
            noise=noise,
            seed=seed,
            genetic=GeneticAlgorithm(**rival) if rival else None,
            rivals_increment=rivals_increment,
            arms=arms,
            records=records,
            threads=threads,
            log=progress.say,
            progress=progress,
        )
        progress.say("writing the page")
        files = [result.page(out, force=force), *(result.save(save, force=force) if save is not None else [])]
    if as_json:
        show_json({**result.to_dict(), "files": [str(f) for f in files]})
    else:
        print_text(f"{reproduction_text(result)}\n\nwritten: {', '.join(str(f) for f in files)}")


@command
def orders(
    *,
    files: Files,
    out: Page = "orders.html",
    reading: ReadingOptions,
    filtered: Annotated[
        bool, Option("--filtered/--no-filtered", help="Whether deflections passed the stock low-pass.")
    ] = True,
    threads: Threads = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Compare integer and fractional orders of the arm's links by cross-validation over runs, as an HTML page."""
    runs = reading.runs(files, apart=True)
    with Progress("", quiet=as_json) as progress:
        found = cross_validate_orders(runs, filtered=filtered, threads=threads, log=progress.say, progress=progress)
        progress.say("writing the page")
        page = cross_validation_page(found, out, force=force)
    if as_json:
        show_json({**found.to_dict(), "files": [str(page)]})
    else:
        print_text(f"{cross_validation_text(found)}\n\nwritten: {page}")


@command
def app(
    *,
    files: Annotated[list[str] | None, Argument(metavar="[FILE...]", help="Measured files to open.")] = None,
    port: Annotated[
        int | None,
        Option(metavar="PORT", help=f"Port of 127.0.0.1; default {DEFAULT_PORT}, or a free one."),
    ] = None,
    browser: Annotated[
        bool, Option("--browser/--no-browser", help="Open a browser, or only print the address.")
    ] = True,
) -> None:
    """Start the local web application for identification in a browser; Ctrl-C stops it."""
    serve(files or [], port=port, browser=browser)
