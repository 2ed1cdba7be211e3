"""Program `ftlm`: table of its commands, and entry point."""

from __future__ import annotations

import importlib
import io
import os
import sys
from collections import UserDict
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from ftlm import _core
from ftlm.cli.framework import EXIT_INTERRUPTED, Command
from ftlm.utils.formatting import escape_standard_streams

#: (module, short help in `ftlm -h`) by command name. The full help of a command is the docstring of its function.
COMMAND_HELP = {
    "demo": ("other", "Identify a simulated arm, and plot the results."),
    "app": ("other", "Identify models in a web browser."),
    "record": ("rig", "Run an experiment on a rig, simulated by default."),
    "open": ("data", "Preview a data file, and suggest the next command."),
    "inspect": ("data", "Show ranges and noise of signals, and check a run."),
    "identify": ("estimation", "Identify a model from measured runs."),
    "identify-frequency": ("estimation", "Identify a model from frequency responses or impedances."),
    "select": ("estimation", "Select the structure that predicts best."),
    "consistency": ("estimation", "Test whether segments of runs share one model."),
    "search": ("estimation", "Rank all orders of an order grid."),
    "certify": ("estimation", "Prove a bound of the error over all orders."),
    "resume": ("estimation", "Resume interrupted order searches."),
    "status": ("estimation", "Show the progress of order searches."),
    "compare": ("model", "Compare a saved model with measured runs."),
    "resid": ("model", "Test the residuals of a saved model."),
    "simulate": ("model", "Simulate a saved model on the inputs of a run."),
    "design-input": ("design", "Design the optimal input of the next experiment."),
    "control": ("design", "Design a controller on a saved model."),
    "input-shaper": ("design", "Design an input shaper on a saved model."),
    "report": ("model", "Write an HTML report of a saved model."),
    "reproduce": ("other", "Recompute the paper's tables and figures."),
    "orders": ("other", "Compare integer and fractional orders of an arm."),
    "plot": ("model", "Plot a saved model for a paper."),
    "export": ("model", "Export a saved model to another tool."),
    "doctor": ("rig", "Show versions, processor cores and drivers."),
}


class CommandTable(UserDict[str, Any]):
    """Mapping from command names to commands; the module of a command is imported on access."""

    def __getitem__(self, name: str) -> TyperCommand:
        """Import the module of the command `name`, and return the command."""
        module, short = super().__getitem__(name)
        commands = importlib.import_module(f"ftlm.cli.{module}_commands")
        # The function of the command `open` is `open_`, because `open` would hide a builtin function.
        function = getattr(commands, name.replace("-", "_"), None) or getattr(commands, f"{name}_")
        application = typer.Typer(rich_markup_mode=None, add_completion=False, context_settings=CONTEXT_SETTINGS)
        application.command(name, cls=Command, short_help=short)(function)
        subcommand = typer.main.get_command(application)
        assert isinstance(subcommand, TyperCommand)
        return subcommand


class Program(TyperGroup):
    """Command group whose modules are imported only when a command is called."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**{**attributes, "commands": CommandTable(COMMAND_HELP)})

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that the arguments name; ``help COMMAND`` is treated as ``COMMAND --help``."""
        if args and args[0] == "help":
            args = [*args[1:2], "--help"]
            if len(args) == 1:
                print(ctx.get_help())
                raise typer.Exit
        if args and args[0] == "validate":
            ctx.fail(
                "No such command 'validate'; ftlm compare MODEL FILE validates a saved model, and --validation FILE of "
                "ftlm identify a new one."
            )
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands with their short help, without importing their modules."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, short) for name, (_, short) in COMMAND_HELP.items()])


CONTEXT_SETTINGS = {"help_option_names": ["-h", "--help"]}
app = typer.Typer(
    name="ftlm",
    cls=Program,
    help="Fractional-order models of flexible machines from measured data.",
    no_args_is_help=True,
    add_completion=True,
    # Rich markup would remove the brackets of units, [s] and [A], from help texts.
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings=CONTEXT_SETTINGS,
)


@app.callback(invoke_without_command=True)
def version(
    show_version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False,
) -> None:
    """Fractional-order models of flexible machines from measured data."""
    if show_version:
        print(f"ftlm {_core.__version__}")
        raise typer.Exit


def main() -> None:
    """Run the program ``ftlm`` with the arguments of the command line."""
    # A standard stream may be closed, as by `>&-`. The next file that is opened must not get its descriptor.
    sys.stdout = sys.stdout or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        # Characters that a terminal cannot encode must not raise an error after a long computation.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    escape_standard_streams()
    try:
        app()
    except KeyboardInterrupt:
        # Ctrl-C was pressed outside a command; commands handle it themselves.
        print("ftlm: interrupted", file=sys.stderr)
        sys.exit(EXIT_INTERRUPTED)
