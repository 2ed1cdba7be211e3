"""Files that commands write: their endings, figures, and the lines that say so."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from ftlm.base.errors import ModelError
from ftlm.base.output import write_atomically
from ftlm.cli.words import in_options

#: Kinds of figures.
FIGURES = ("png", "pdf", "svg")


def check_ending(path: str | None, ending: str, why: str = "") -> None:
    """Refuse a name with another ending; none is no file to write."""
    if path is not None and Path(path).suffix.lower() != ending:
        raise ModelError(f"{path} does not end in {ending}{why}; name it so")


def figure_kind(path: str | None) -> str:
    """The kind of a figure by its name's ending; a name without one of them is refused, none is no figure."""
    kind = "" if path is None else Path(path).suffix.removeprefix(".").lower()
    if path is not None and kind not in FIGURES:
        raise ModelError(f"{path} ends in {kind or 'nothing'!r}; write .png, .pdf or .svg")
    return kind


def write_figure(figure: Any, path: str, *, force: bool) -> None:
    """Write a figure of matplotlib."""
    data = io.BytesIO()
    figure.savefig(data, format=figure_kind(path), dpi=200)
    write_atomically(path, data.getvalue(), force=force)


def say_written(*paths: str | None) -> None:
    """Print what was written; none is nothing."""
    for path in paths:
        if path is not None:
            print(in_options(f"written: {path}"))
