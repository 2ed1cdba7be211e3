"""Commands for saved models: compare, resid, simulate, report, plot, export."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated, Literal

import typer
from typer import Argument, Option

from ftlm.analysis.conversion import export_text
from ftlm.cli.framework import (
    EXIT_VALIDATION,
    announce_simulation,
    command,
    figure_kind,
    interval,
    output_file,
    print_outcome,
    show,
    write_figure,
)
from ftlm.cli.options import BlockPulses, Page, SavedModel
from ftlm.cli.reading_options import Files, Force, Json, Number, ReadingOptions, Text, Texts
from ftlm.data.run import Run
from ftlm.errors import ModelError
from ftlm.model.model import Model
from ftlm.model.serialization import load_model
from ftlm.plot import matplotlib_figures as plots
from ftlm.report.html_report import model_page
from ftlm.utils.files import write_atomically


def _with_runs(
    model: str, reading: ReadingOptions, files: Sequence[str] | None, *, quiet: bool
) -> tuple[Model, list[Run]]:
    """Load a saved model and its runs."""
    loaded = load_model(model)
    runs = reading.runs(files, loaded.structure)
    announce_simulation(runs, len(loaded.outputs), quiet=quiet)
    return loaded, runs


@command
def compare(
    *,
    model: SavedModel,
    files: Files,
    min_fit: Annotated[Number, Option(help="Exit with 4 if the simulation fits less [%].")] = None,
    reading: ReadingOptions,
    m: BlockPulses = None,
    as_json: Json = False,
) -> None:
    """Print the equation error and output error of a saved model on measured runs."""
    loaded, runs = _with_runs(model, reading, files, quiet=as_json)
    comparison = loaded.compare(runs, m=m)
    show(comparison, as_json=as_json)
    if min_fit is not None:
        # Negated so that a fit that is not a number is too low.
        low = {name: fit for name, fit in comparison.fit.items() if not fit >= min_fit}
        if low:
            listed = ", ".join(f"{name} {fit:.4g} %" for name, fit in low.items())
            print(f"ftlm: fit below {min_fit:g} %: {listed}", file=sys.stderr)
            raise typer.Exit(EXIT_VALIDATION)


@command
def resid(
    *,
    model: SavedModel,
    files: Files,
    lags: Annotated[int, Option(min=1, help="Largest lag in samples.")] = 25,
    reading: ReadingOptions,
    as_json: Json = False,
) -> None:
    """Test residuals for whiteness and independence of the inputs; exit code 4 if a test fails."""
    loaded, runs = _with_runs(model, reading, files, quiet=as_json)
    tests = loaded.resid(runs, lags=lags)
    show(tests, as_json=as_json)
    if not tests.passed:
        raise typer.Exit(EXIT_VALIDATION)


@command
def simulate(
    *,
    model: SavedModel,
    file: Annotated[str, Argument(metavar="FILE", help="Run with the inputs of the simulation.")],
    out: Annotated[str, output_file("Write the simulated run to this file.", metavar="CSV")],
    reading: ReadingOptions,
    tolerance: Annotated[float, Option(help="Relative tolerance of the step refinement.")] = 1e-6,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Simulate a saved model on the inputs of a run and write the outputs as csv."""
    loaded, runs = _with_runs(model, reading, [file], quiet=as_json)
    free = loaded.simulate(runs[0], tolerance=tolerance)
    free.to_csv(out, force=force)
    sentence = f"{free.length} rows of {', '.join(free.outputs)} written to {out}"
    print_outcome(sentence, as_json=as_json, written=out, rows=free.length, outputs=list(free.outputs))


@command
def report(
    *,
    model: SavedModel,
    out: Page,
    validation: Annotated[Texts, Option(metavar="FILE", help="Run to validate the model on.")] = None,
    reading: ReadingOptions,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write the HTML report of a saved model, with validation runs."""
    loaded, runs = _with_runs(model, reading, validation, quiet=as_json)
    page = model_page(loaded, out, validation=runs or None, force=force)
    print_outcome(f"written: {page}", as_json=as_json, written=str(page))


@command
def plot(
    *,
    model: SavedModel,
    out: Annotated[str, output_file("Write the figure to this .png, .pdf or .svg file.")],
    files: Annotated[Texts, Argument(metavar="[RUN]...", help="Runs, for fit, residuals and series.")] = None,
    kind: Annotated[
        Literal["fit", "residuals", "series", "bode", "poles", "step", "impulse"],
        Option(help="Kind of figure; series: residuals over time."),
    ] = "fit",
    reading: ReadingOptions,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Plot a saved model: fit or residuals on runs, Bode plot, poles, step or impulse response."""
    figure_kind(out)
    loaded, runs = _with_runs(model, reading, files, quiet=as_json)
    alone = {"bode": plots.bode, "poles": plots.poles, "step": plots.step, "impulse": plots.impulse}
    if not runs and kind not in alone:
        raise ModelError(f"--kind {kind} needs at least one run; give files")
    if kind in alone:
        figure = alone[kind](loaded)
    elif kind == "fit":
        figure = plots.fit(loaded, runs, inputs=True)
    elif kind == "series":
        figure = plots.residual_series(loaded.compare(runs))
    else:
        figure = plots.residuals(loaded.resid(runs))
    write_figure(figure, out, force=force)
    print_outcome(f"written: {out}", as_json=as_json, written=out)


@command
def export(
    *,
    model: SavedModel,
    to: Annotated[
        Literal["control", "matlab", "json"],
        Option(help="control: Python; matlab: FOMCON script; json."),
    ],
    band: Annotated[Text, Option(metavar="LOW:HIGH", help="Frequency band for control [rad/s].")] = None,
    order: Annotated[int, Option(help="Order of Oustaloup's filter, for control.")] = 5,
    out: Annotated[Text, output_file("Write to this file; default standard output.")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Export a saved model for another tool, to a file or to standard output."""
    limits = None if band is None else _both_ends(band)
    text = export_text(load_model(model), to, band=limits, order=order)
    if out is None:
        print_outcome(text.rstrip("\n"), as_json=as_json, to=to, text=text)
    else:
        write_atomically(out, text.encode(), force=force)
        print_outcome(f"written: {out}", as_json=as_json, to=to, written=out)


def _both_ends(band: str) -> tuple[float, float]:
    low, high = interval(band, "--band", "0.1:100")
    if low is None or high is None:
        raise ModelError(f"--band {band!r} lacks an end; write LOW:HIGH in rad/s, such as 0.1:100")
    return low, high
