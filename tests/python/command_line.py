"""Run the command line in the process of the tests, which saves starting Python."""

from __future__ import annotations

import contextlib
import subprocess
from pathlib import Path

from typer.testing import CliRunner

from ftlm.cli.main import app


def run_command(*words: str, cwd: Path | None = None, columns: int = 200) -> subprocess.CompletedProcess[str]:
    """Run a command without colors; unexpected exceptions are raised."""
    with contextlib.nullcontext() if cwd is None else contextlib.chdir(cwd):
        result = CliRunner().invoke(
            app, list(words), env={"NO_COLOR": "1", "COLUMNS": str(columns)}, catch_exceptions=False
        )
    return subprocess.CompletedProcess(words, result.exit_code, result.stdout, result.stderr)
