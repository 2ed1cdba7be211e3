"""The program `ftlm`: its commands in the order in which its help lists them."""

from __future__ import annotations

import io
import os
import sys
from typing import Annotated

import typer

from ftlm import _core
from ftlm.cli.agreement import agreement
from ftlm.cli.command import Command
from ftlm.cli.control import control, shape
from ftlm.cli.design import design_input
from ftlm.cli.frequency import identify_frequency
from ftlm.cli.identify import identify, resume, search, status
from ftlm.cli.inspect import doctor, inspect, open_
from ftlm.cli.judge import compare, export, plot, report, resid, simulate
from ftlm.cli.page import app as page
from ftlm.cli.paper import demo, orders, reproduce
from ftlm.cli.record import record
from ftlm.cli.select import select

app = typer.Typer(
    name="ftlm",
    help="Fractional-order models of flexible machines from measured data.",
    no_args_is_help=True,
    add_completion=True,
    # Marks of rich would take the brackets of units, [s] and [A], out of every help text.
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


for _command in (
    demo, page, record, open_, inspect, identify, identify_frequency, select, agreement, search, resume, status,
    compare, resid, simulate, design_input, control, shape, report, reproduce, orders, plot, export, doctor,
):  # fmt: skip
    app.command(_command.__name__.rstrip("_").replace("_", "-"), cls=Command)(_command)


def main() -> None:
    """Entry point."""
    # Who closes an output, as `>&-` does, wants none; what is opened next must not take its place.
    sys.stdout = sys.stdout or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        # A terminal that knows no Greek must not take a result away after an hour's work.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    app()
