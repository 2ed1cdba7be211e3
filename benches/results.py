"""Where measured figures go: benches/RESULTS.md, under the command, commit and machine that they were taken with."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

RESULTS = Path(__file__).with_name("RESULTS.md")


def commit() -> str:
    """Short name of the commit that is measured."""
    found = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"


def machine() -> str:
    """Processor family and cores."""
    return f"{platform.machine()}, {os.cpu_count()} cores"


def heading() -> str:
    """The command that runs, without ``--write``, with commit and machine."""
    given = [f'"{a}"' if set(a) & {"|", " "} else a for a in sys.argv[1:] if a != "--write"]
    command = " ".join([f"python benches/{Path(sys.argv[0]).name}", *given])
    return f"`{command}`, commit {commit()}, {machine()}"


def append(lines: list[str]) -> None:
    """Add a block of lines to the file."""
    text = RESULTS.read_text(encoding="utf-8") if RESULTS.exists() else "# Results\n"
    RESULTS.write_text(text.rstrip("\n") + "\n\n" + "\n".join(lines) + "\n", encoding="utf-8")
