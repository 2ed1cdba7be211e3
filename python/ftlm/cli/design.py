"""The command that lays out the next experiment: design-input."""

from __future__ import annotations

from typing import Annotated, Literal

from typer import Option

from ftlm.base.errors import ModelError
from ftlm.base.output import COMMAND, check_free
from ftlm.base.progress import Progress
from ftlm.cli.command import command, show
from ftlm.cli.options import Force, Json, Noise, Number, ReadingOptions, SavedModel, Text, Texts
from ftlm.cli.words import numbers
from ftlm.cli.written import check_ending, figure_kind, say_written, write_figure
from ftlm.excitation import experiment
from ftlm.model.model import load_model
from ftlm.report import design_plots


@command
def design_input(
    *, model: SavedModel,
    like: Annotated[
        Text, Option(metavar="FILE", help="A run that the machine bore: what is not said is as in it.")
    ] = None,
    reading: ReadingOptions,
    duration: Annotated[Number, Option(help="Length of the run [s].")] = None,
    peak: Annotated[
        Texts, Option(metavar="A or INPUT=A", help="Largest size of each input, or of one of several.")
    ] = None,
    slew: Annotated[
        Texts, Option(metavar="A or INPUT=A", help="Fastest change of an input, a second; default none.")
    ] = None,
    limits: Annotated[
        Texts, Option("--limit", metavar="OUTPUT=A", help="Largest size of an output, in the model's units; or inf.")
    ] = None,
    names: Annotated[
        Texts, Option("--for", metavar="NAME", help="A number to be told; default every free order.")
    ] = None,
    criterion: Annotated[
        Literal["D", "E"], Option(help="D: all their intervals together; E: the widest of them.")
    ] = "D",
    noise: Noise = None,
    period: Annotated[
        Number, Option(help="Of the square set beside it [s]; default a fifth of the duration.")
    ] = None,
    seed: Annotated[int, Option(min=0, help="Of random inputs to begin with.")] = 0,
    out: Annotated[
        Text, Option("-o", "--out", metavar="FILE", help="Run to write, .csv: ftlm record --input csv takes it.")
    ] = None,
    picture: Annotated[Text, Option("--plot", metavar="FILE", help="Figure to write: .png, .pdf or .svg.")] = None,
    force: Force = False, as_json: Json = False,
) -> None:  # fmt: skip
    """Lay out the next experiment: the input that tells a model's numbers best within the limits of the machine."""
    check_free(out, picture, force=force, words=COMMAND)
    check_ending(out, ".csv", ", as a run for a rig does")
    figure_kind(picture)
    loaded = load_model(model)
    run = None if like is None else reading.runs([like])[0]
    with Progress("designing", quiet=as_json) as progress:
        found = experiment.design_input(
            loaded, like=run, duration=duration, step=None if like is not None else reading.sampling,
            peak=_sizes("--peak", peak), slew=_sizes("--slew", slew), limits=numbers("--limit", limits) or None,
            names=names, criterion=criterion, noise=numbers("--noise", noise) or None, period=period, seed=seed,
            progress=progress,
        )  # fmt: skip
    if out is not None:
        found.save(out, force=force)
    if picture is not None:
        write_figure(design_plots.design(found), picture, force=force)
    show(found, as_json=as_json)
    if not as_json:
        say_written(out, picture)


def _sizes(option: str, given: list[str] | None) -> float | dict[str, float] | None:
    """One number for all inputs, or numbers by name."""
    if given and len(given) == 1 and "=" not in given[0]:
        try:
            return float(given[0])
        except ValueError:
            raise ModelError(f"{option} {given[0]!r} is neither a number nor INPUT=NUMBER") from None
    return numbers(option, given) or None
