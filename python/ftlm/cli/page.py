"""The command that opens a page in the browser: app."""

from __future__ import annotations

from typing import Annotated

from typer import Argument, Option

from ftlm.app.serve import PORT, serve
from ftlm.cli.command import command


@command
def app(
    *, files: Annotated[list[str] | None, Argument(metavar="[FILE...]", help="Measured files to open at once.")] = None,
    port: Annotated[
        int | None, Option(metavar="PORT", help=f"Of 127.0.0.1; default {PORT}, or any other where that is taken.")
    ] = None,
    browser: Annotated[
        bool, Option("--browser/--no-browser", help="Open a browser, or print the address alone.")
    ] = True,
) -> None:  # fmt: skip
    """From a file to a model in a browser: a local page that nobody else can open; Ctrl-C ends it."""
    serve(files or [], port=port, browser=browser)
