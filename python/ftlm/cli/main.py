"""Program `ftlm`: list of its commands in the order of the help."""

from __future__ import annotations

import io
import os
import sys
from typing import Annotated

import typer

from ftlm import _core
from ftlm.cli.data_commands import doctor, inspect, open_, record
from ftlm.cli.design_commands import control, design_input, input_shaper
from ftlm.cli.estimation_commands import (
    certify,
    consistency,
    identify,
    identify_frequency,
    resume,
    search,
    select,
    status,
)
from ftlm.cli.framework import EXIT_INTERRUPTED, Command
from ftlm.cli.model_commands import compare, export, plot, report, resid, simulate
from ftlm.cli.other_commands import app as page
from ftlm.cli.other_commands import demo, orders, reproduce
from ftlm.utils.formatting import escape_standard_streams

app = typer.Typer(
    name="ftlm",
    help="Fractional-order models of flexible machines from measured data.",
    no_args_is_help=True,
    add_completion=True,
    # Rich markup would remove the brackets of units, [s] and [A], from help texts.
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def version(
    show_version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False,
) -> None:
    """Fractional-order models of flexible machines from measured data."""
    if show_version:
        print(f"ftlm {_core.__version__}")
        raise typer.Exit


#: Short help of each command in `ftlm -h`; its docstring is its own help.
COMMAND_HELP = {
    demo: "Identify a simulated arm, and draw what came out.",
    page: "From a file to a model, in a browser.",
    record: "Drive a rig, simulated by default, and record a run.",
    open_: "Say what a file is, and what to type next.",
    inspect: "Show ranges, noise and rest of a run, and advice.",
    identify: "Identify a model from runs, with a verdict.",
    identify_frequency: "The same from frequency responses, impedances.",
    select: "Choose the structure that predicts.",
    consistency: "Test whether segments of runs are one model.",
    search: "Rank all orders of an order grid.",
    certify: "Prove a bound over all orders in intervals.",
    resume: "Go on with the searches of a store.",
    status: "Show how far the searches of a store are.",
    compare: "Judge a saved model on measured runs.",
    resid: "Test what a saved model leaves over.",
    simulate: "Run a saved model on a run's inputs.",
    design_input: "Lay out the experiment that tells most.",
    control: "Design a controller on a saved model.",
    input_shaper: "Make an input shaper of a saved model's poles.",
    report: "Write the report of a saved model.",
    reproduce: "Recompute the paper's tables and figures.",
    orders: "Judge whole and fractional orders on a real arm.",
    plot: "Draw a saved model for a paper.",
    export: "Write a saved model for another tool.",
    doctor: "Show versions, cores, and what is installed.",
}
for _command, _short in COMMAND_HELP.items():
    name = _command.__name__.rstrip("_").replace("_", "-")
    app.command(name, cls=Command, short_help=_short)(_command)


def main() -> None:
    """Run the program."""
    # Who closes an output, as `>&-` does, wants none; what is opened next must not take its place.
    sys.stdout = sys.stdout or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        # A terminal that knows no Greek must not take a result away after an hour's work.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    escape_standard_streams()
    try:
        app()
    except KeyboardInterrupt:
        # It came before a command or after one.
        print("ftlm: interrupted", file=sys.stderr)
        sys.exit(EXIT_INTERRUPTED)
