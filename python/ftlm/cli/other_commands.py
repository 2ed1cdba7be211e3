"""Commands demo, reproduce, orders and app."""

from __future__ import annotations

from pathlib import Path

from ftlm.app.server import serve
from ftlm.cli.framework import NonNegative, OutputPage, Positive, command, print_text, show_json
from ftlm.cli.options import GeneticOptions
from ftlm.cli.reading_options import ReadingOptions, given_fields
from ftlm.errors import ModelError
from ftlm.estimation.genetic import GeneticAlgorithm
from ftlm.progress import Progress
from ftlm.reproduction import reproduction
from ftlm.reproduction.cross_validation import cross_validate_orders, cross_validation_page, cross_validation_text
from ftlm.reproduction.demo import demo_details, demo_page, demo_text, run_demo
from ftlm.reproduction.report import reproduction_text
from ftlm.reproduction.reproduction import ALWAYS_SAVED
from ftlm.reproduction.workload import COMPARISON_INCREMENT
from ftlm.utils.files import check_folder
from ftlm.utils.resources import estimate_duration
from ftlm.utils.validation import check_threads

#: Processor time of `ftlm demo` with the order increment 0.1 on the reference machine [s].
DEMO_SECONDS = 22.0


@command
def demo(
    *,
    out: str = "ftlm-demo",
    increment: float = 0.1,
    noise: float = 1e-4,
    seed: NonNegative = 1,
    threads: int | None = None,
    force: bool = False,
    verbose: bool = False,
    as_json: bool = False,
) -> None:
    """Simulate both joints of the arm, identify them with innovation lengths 1, 3, 5, 7, and write models and charts.

    The paper's order grid has the increment 0.05, which takes minutes.

    Options
    -------
    out : FOLDER
        Folder to write to.
    noise
        Noise on every angle [rad].
    seed
        Seed of the noise.
    """
    with Progress("", quiet=as_json) as progress:
        progress.announce("the demo", estimate_duration(DEMO_SECONDS * (0.1 / increment) ** 2, check_threads(threads)))
        result = run_demo(
            Path(out),
            increment=increment,
            noise=noise,
            seed=seed,
            threads=threads,
            force=force,
            log=progress.set_label,
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
    out: OutputPage = "paper.html",
    save: str | None = None,
    square: str | None = None,
    sine: str | None = None,
    reading: ReadingOptions,
    increment: float = 0.05,
    noise: float = 1e-4,
    seed: NonNegative = 1,
    arms: list[str] | None = None,
    records: Positive = 3,
    comparison_increment: float = COMPARISON_INCREMENT,
    genetic: GeneticOptions,
    threads: int | None = None,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Recompute the tables and figures of the paper on simulated or measured runs, as one HTML page.

    Options
    -------
    save : FOLDER
        Also write runs, models and tables to this folder.
    square : FILE
        Measured run to identify from.
    sine : FILE
        Measured run to validate on.
    noise
        Noise on every angle of the virtual rig [rad].
    seed
        Seed of the noise.
    arms : ARM
        Simulated arm for the verdicts; several, or all.
    records
        Records per arm, with different noise.
    comparison_increment
        Minimum order increment in the comparison of optimizers.
    """
    if save is not None:
        check_folder(Path(save), ALWAYS_SAVED, force=force)
    if sine is not None and square is None:
        raise ModelError("--sine is given without --square; give both, or neither of them to use the virtual rig")
    measurements = reading.runs([f for f in (square, sine) if f is not None], apart=True)
    rival = given_fields(genetic)
    with Progress("", quiet=as_json) as progress:
        result = reproduction.reproduce(
            *measurements,
            increment=increment,
            noise=noise,
            seed=seed,
            genetic=GeneticAlgorithm(**rival) if rival else None,
            comparison_increment=comparison_increment,
            arms=arms,
            records=records,
            threads=threads,
            log=progress.print_label,
            progress=progress,
        )
        progress.print_label("writing the page")
        files = [result.page(out, force=force), *(result.save(save, force=force) if save is not None else [])]
    if as_json:
        show_json({**result.to_dict(), "files": [str(f) for f in files]})
    else:
        print_text(f"{reproduction_text(result)}\n\nwritten: {', '.join(str(f) for f in files)}")


@command
def orders(
    files: list[str],
    *,
    out: OutputPage = "orders.html",
    reading: ReadingOptions,
    filtered: bool = True,
    threads: int | None = None,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Compare integer and fractional orders of the arm's links by cross-validation over runs, as an HTML page.

    Options
    -------
    filtered
        Whether deflections passed the stock low-pass filter.
    """
    runs = reading.runs(files, apart=True)
    with Progress("", quiet=as_json) as progress:
        result = cross_validate_orders(
            runs, filtered=filtered, threads=threads, log=progress.print_label, progress=progress
        )
        progress.print_label("writing the page")
        page = cross_validation_page(result, out, force=force)
    if as_json:
        show_json({**result.to_dict(), "files": [str(page)]})
    else:
        print_text(f"{cross_validation_text(result)}\n\nwritten: {page}")


@command
def app(files: list[str] | None = None, *, port: int | None = None, browser: bool = True) -> None:
    """Start the local web application for identification in a browser; Ctrl-C stops it.

    Arguments
    ---------
    files : [FILE...]
        Measured files to open.

    Options
    -------
    port : PORT
        Port of 127.0.0.1; default 8347, or a free one.
    browser
        Open a browser, or only print the address.
    """
    serve(files or [], port=port, browser=browser)
