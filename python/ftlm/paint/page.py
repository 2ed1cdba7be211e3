"""One HTML file that opens offline: sections with their warnings first, then words, tables and charts."""

from __future__ import annotations

import base64
import hashlib
import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup

from ftlm._core import __version__
from ftlm.base.output import write_atomically
from ftlm.paint.figure import Figure
from ftlm.paint.lines import chart_css
from ftlm.paint.table import Table


@dataclass(frozen=True)
class Section:
    """One section of a report.

    Parameters
    ----------
    heading
        Heading.
    paragraphs
        Text, escaped unless it is ``Markup``.
    warnings
        Shown first, in a box.
    tables, figures
        See :class:`ftlm.report.Table` and :func:`ftlm.report.line_chart`.
    small
        Whether two figures stand side by side where there is room.
    more
        Further warnings, folded away below the first ones.
    fold
        What is written on the fold behind which the rest stands; on paper it is open.
    folded_paragraphs, folded
        Text and tables behind it.
    """

    heading: str
    paragraphs: Sequence[str] = ()
    warnings: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    small: bool = False
    more: Sequence[str] = ()
    fold: str = "Numbers"
    folded_paragraphs: Sequence[str] = ()
    folded: Sequence[Table] = ()

    def __post_init__(self) -> None:
        # A text is a sequence of letters, too; nobody wants a paragraph for each.
        for name in ("paragraphs", "warnings", "more", "folded_paragraphs"):
            if isinstance(getattr(self, name), str):
                object.__setattr__(self, name, (getattr(self, name),))


@cache
def _template() -> Template:
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(resources.files("ftlm.paint").joinpath("page.html.j2").read_text("utf-8"))


@cache
def look() -> Markup:
    """What all pages look alike in."""
    return Markup(resources.files("ftlm.paint").joinpath("look.css").read_text("utf-8"))  # our own file


@cache
def chart_script() -> str:
    """What makes charts zoom, and sliders read them out."""
    return resources.files("ftlm.paint").joinpath("charts.js").read_text("utf-8")


@cache
def _script() -> tuple[Markup, str]:
    """The script of the charts, and the hash under which the page allows it and nothing else."""
    text = chart_script()
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return Markup(text), f"sha256-{digest}"  # our own file


def write_page(
    path: str | os.PathLike[str], *, title: str, sections: Sequence[Section], lead: str = "", force: bool = False,
    verdict: str = "",
) -> Path:  # fmt: skip
    """Write sections as one HTML file.

    Parameters
    ----------
    path
        File to write.
    title
        Title.
    sections
        In their order on the page.
    lead
        What a hurried reader should know, below the title.
    force
        Overwrite an existing file.
    verdict
        What stands before everything else, escaped unless it is ``Markup``.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    DataError
        The file exists and ``force`` is not set, or cannot be written.
    """
    script, digest = _script()
    page = _template().render(
        title=title, lead=lead, sections=list(sections), version=__version__, look=look(), chart_css=chart_css(),
        script=script, script_hash=digest, verdict=verdict,
    )  # fmt: skip
    # A name may hold half a surrogate pair, which no file can.
    return write_atomically(path, page.encode("utf-8", "backslashreplace"), force=force)


@dataclass(frozen=True)
class Page:
    """What a page says: its title, its sections, and what a hurried reader should know."""

    title: str
    sections: Sequence[Section]
    lead: str


class Reported(ABC):
    """A result that is its own page."""

    @abstractmethod
    def _page(self) -> Page:
        """What its page says."""

    def report(self, path: str | os.PathLike[str], *, force: bool = False) -> Path:
        """Write the result as one HTML file that opens offline.

        Parameters
        ----------
        path
            File to write.
        force
            Overwrite an existing file.

        Returns
        -------
        pathlib.Path
            The file.

        Raises
        ------
        DataError
            The file exists and ``force`` is not set, or cannot be written.
        """
        page = self._page()
        return write_page(path, title=page.title, sections=page.sections, lead=page.lead, force=force)
