"""Commands for saved models: compare, resid, simulate, report, plot and export."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Literal

import typer

from ftlm.analysis.conversion import export_text
from ftlm.cli.framework import (
    EXIT_VALIDATION,
    OptionalOutputFile,
    OutputFile,
    OutputPage,
    Positive,
    announce_simulation,
    command,
    figure_kind,
    interval,
    print_outcome,
    show,
    write_figure,
)
from ftlm.cli.reading_options import ReadingOptions
from ftlm.data.run import Run
from ftlm.errors import ModelError
from ftlm.model.model import Model
from ftlm.model.serialization import load_model
from ftlm.plot import matplotlib_figures as plots
from ftlm.report.html_report import model_page
from ftlm.utils.files import write_atomically
from ftlm.utils.formatting import plural


def _with_runs(
    model: str, reading: ReadingOptions, files: Sequence[str] | None, *, quiet: bool
) -> tuple[Model, list[Run]]:
    """Load a saved model and the runs in files; print the expected duration of their simulation if it is long."""
    loaded = load_model(model)
    runs = reading.runs(files, loaded.structure)
    announce_simulation(runs, len(loaded.outputs), quiet=quiet)
    return loaded, runs


@command
def compare(
    model: str,
    files: list[str],
    *,
    min_fit: float | None = None,
    reading: ReadingOptions,
    m: int | None = None,
    as_json: bool = False,
) -> None:
    """Print the equation error and output error of a saved model on measured runs.

    Options
    -------
    min_fit
        Minimum fit; exit with code 4 if the fit is below it [%].
    """
    loaded, runs = _with_runs(model, reading, files, quiet=as_json)
    comparison = loaded.compare(runs, m=m)
    show(comparison, as_json=as_json)
    if min_fit is not None:
        # The comparison is negated, so that a fit of NaN counts as too low.
        low = {name: fit for name, fit in comparison.fit.items() if not fit >= min_fit}
        if low:
            fits_text = ", ".join(f"{name} {fit:.4g} %" for name, fit in low.items())
            print(f"ftlm: fit below {min_fit:g} %: {fits_text}", file=sys.stderr)
            raise typer.Exit(EXIT_VALIDATION)


@command
def resid(model: str, files: list[str], *, lags: Positive = 25, reading: ReadingOptions, as_json: bool = False) -> None:
    """Test residuals for whiteness and independence of the inputs; exit code 4 if a test fails.

    Options
    -------
    lags
        Maximum lag in samples.
    """
    loaded, runs = _with_runs(model, reading, files, quiet=as_json)
    tests = loaded.resid(runs, lags=lags)
    show(tests, as_json=as_json)
    if not tests.passed:
        raise typer.Exit(EXIT_VALIDATION)


@command
def simulate(
    model: str,
    file: str,
    *,
    out: OutputFile,
    reading: ReadingOptions,
    tolerance: float = 1e-06,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Simulate a saved model on the inputs of a run and write the outputs as csv.

    Arguments
    ---------
    file : FILE
        Run with the inputs of the simulation.

    Options
    -------
    out : CSV
        Write the simulated run to this file.
    tolerance
        Relative tolerance of the step refinement.
    """
    loaded, runs = _with_runs(model, reading, [file], quiet=as_json)
    free = loaded.simulate(runs[0], tolerance=tolerance)
    free.to_csv(out, force=force)
    sentence = f"{plural(free.length, 'row')} of {', '.join(free.outputs)} written to {out}"
    print_outcome(sentence, as_json=as_json, written=out, rows=free.length, outputs=list(free.outputs))


@command
def report(
    model: str,
    *,
    out: OutputPage,
    validation: list[str] | None = None,
    reading: ReadingOptions,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Write the HTML report of a saved model, with validation runs.

    Options
    -------
    validation : FILE
        Run to validate the model on.
    """
    loaded, runs = _with_runs(model, reading, validation, quiet=as_json)
    page = model_page(loaded, out, validation=runs or None, force=force)
    print_outcome(f"written: {page}", as_json=as_json, written=str(page))


@command
def plot(
    model: str,
    files: list[str] | None = None,
    *,
    out: OutputFile,
    kind: Literal["fit", "residuals", "series", "bode", "poles", "step", "impulse"] = "fit",
    reading: ReadingOptions,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Plot a saved model: fit or residuals on runs, Bode plot, poles, step or impulse response.

    Arguments
    ---------
    files : [RUN]...
        Runs, for fit, residuals and series.

    Options
    -------
    out : FILE
        Write the figure to this .png, .pdf or .svg file.
    kind
        Kind of figure; series: residuals over time.
    """
    figure_kind(out)
    loaded, runs = _with_runs(model, reading, files, quiet=as_json)
    plots_of_model = {"bode": plots.bode, "poles": plots.poles, "step": plots.step, "impulse": plots.impulse}
    if not runs and kind not in plots_of_model:
        raise ModelError(f"--kind {kind} needs at least one run; give files")
    if kind in plots_of_model:
        figure = plots_of_model[kind](loaded)
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
    model: str,
    *,
    to: Literal["control", "matlab", "json"],
    band: str | None = None,
    order: int = 5,
    out: OptionalOutputFile = None,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Export a saved model for another tool, to a file or to standard output.

    Options
    -------
    to
        control: Python; matlab: FOMCON script; json.
    band : LOW:HIGH
        Frequency band for control [rad/s].
    order
        Order of Oustaloup's filter, for control.
    out : FILE
        Write to this file; default standard output.
    """
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
