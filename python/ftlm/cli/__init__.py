"""The command line: results to standard output, progress to standard error, exit codes that scripts can read."""

from ftlm.cli.main import app, main

__all__ = ["app", "main"]
