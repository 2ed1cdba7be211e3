"""The command line: results to standard output, progress to standard error, exit codes that scripts can read."""

from ftlm.cli.commands import main
from ftlm.cli.options import app

__all__ = ["app", "main"]
