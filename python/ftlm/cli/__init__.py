"""Command line: results on standard output, progress on standard error, exit codes for scripts."""

from ftlm.cli.main import app, main

__all__ = ["app", "main"]
