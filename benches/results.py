"""Measured figures: benches/results.json, a record for each command, and the page that is made from it.

A bench writes its record with ``--write``: command, commit, date, machine, load, versions and figures. A later run
of the same command replaces it. ``python benches/results.py`` makes benches/RESULTS.md from the records.
"""

from __future__ import annotations

import datetime
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from importlib import metadata
from itertools import groupby
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).with_name("results.json")
PAGE = RESULTS.with_name("RESULTS.md")
#: Packages whose versions stand in a record.
PACKAGES = ("ftlm", "numpy", "scipy")
#: Most figures of a record that the page has.
MAX_PAGE_FIGURES = 6
LEAD = """## Measured figures

`python benches/results.py` makes this page from `benches/results.json`, which benches write with `--write`. Load is
that of the machine, x86-64 with two cores. Ratios are taken in one run.
"""


def commit() -> str:
    """Short name of the commit that is measured."""
    process = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    return process.stdout.strip() or "unknown"


def machine() -> str:
    """Processor family and cores."""
    return f"{platform.machine()}, {os.cpu_count()} cores"


def command() -> str:
    """The command that runs, without ``--write``."""
    words = [f'"{a}"' if set(a) & {"|", " "} else a for a in sys.argv[1:] if a != "--write"]
    return " ".join([f"python benches/{Path(sys.argv[0]).name}", *words])


def heading() -> str:
    """The command that runs, with commit and machine."""
    return f"`{command()}`, commit {commit()}, {machine()}"


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that are there."""
    versions_by_name = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions_by_name[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions_by_name


def figures_in(lines: list[str]) -> list[list[str]]:
    """Pairs (name, value) from printed lines: items of lists, and rows of tables with the heads of their columns."""
    figures: list[list[str]] = []
    heads: list[str] = []
    for line in lines:
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if not line.lstrip().startswith("|"):
            heads = []
            if line.startswith("- ") and not line.startswith(("- `", "- commit ")):
                name, _, value = line[2:].partition(": ")
                figures.append([name, value])
        elif not heads:
            heads = cells
        elif set(line) - set("|- :"):
            rest = (f"{head} {cell}".strip() for head, cell in zip(heads[1:], cells[1:], strict=False) if cell)
            figures.append([cells[0], "; ".join(rest)])
    return figures


def save(lines: list[str]) -> None:
    """Write the figures of a run as the record of its command, and the page."""
    record = {
        "command": command(),
        "commit": commit(),
        "date": datetime.date.today().isoformat(),
        "machine": machine(),
        "load": round(os.getloadavg()[0], 1),
        "versions": versions(),
        "figures": figures_in(lines),
    }
    records = [r for r in read() if r["command"] != record["command"]]
    write(sorted([*records, record], key=lambda r: str(r["command"])))


def read() -> list[dict[str, Any]]:
    """All records."""
    rows: list[dict[str, Any]] = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else []
    return rows


def write(records: list[dict[str, Any]]) -> None:
    """Write all records, and the page."""
    RESULTS.write_text(json.dumps(records, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    PAGE.write_text(page(records), encoding="utf-8")


def page(records: list[dict[str, Any]]) -> str:
    """Tables of all records, those of one bench together."""
    parts = [LEAD]
    for bench, each in groupby(records, key=lambda r: re.search(r"benches/(\w+)", r["command"])[1]):  # type: ignore[index]
        parts.append(f"### {bench}\n")
        for r in each:
            load = "" if r["load"] is None else f", load {r['load']:g}"
            heads = f"|`{r['command']}`|{r['commit']}, {r['date']}{load}|"
            parts += [heads, "|---|---|", *(f"|{name}|{value}|" for name, value in r["figures"][:MAX_PAGE_FIGURES]), ""]
    return "\n".join(parts)


class ResultStore:
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


if __name__ == "__main__":
    write(read())
