"""Where measured figures go: benches/RESULTS.md, under the command, commit and machine that they were taken with."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

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


class Kept:
    """What was measured so far, a line a piece, so that a long measurement goes on where it was stopped."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        # Of what is imported now, whatever is committed while it is measured.
        self.commit = commit()
        self.known: dict[str, dict[str, Any]] = {}
        if path is not None and path.exists():
            for line in path.read_text(encoding="utf-8").splitlines():
                row = json.loads(line)
                self.known[row["of"]] = row

    def row(self, of: str, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """A piece from the file, whatever commit it was measured with, or measured and kept with its commit."""
        if of not in self.known:
            self.known[of] = {"of": of, "commit": self.commit, **measure()}
            if self.path is not None:
                with self.path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(self.known[of]) + "\n")
        return self.known[of]

    def commits(self, names: list[str]) -> str:
        """Commits that some pieces were measured with, in words."""
        return ", ".join(dict.fromkeys(self.known[n]["commit"] for n in names))
