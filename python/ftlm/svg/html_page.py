"""HTML pages, sections and tables of reports, from plain data."""

from __future__ import annotations

import base64
import hashlib
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from itertools import accumulate
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup, escape

from ftlm._core import __version__
from ftlm.svg.figure import Figure
from ftlm.svg.line_chart import chart_css
from ftlm.utils.files import check_ending, write_atomically
from ftlm.utils.formatting import Cell, number

#: Columns from which a table has small type, so that the paper's fifteen columns fit a laptop screen.
DENSE_MIN_COLUMNS = 12
NOT_IN_MODEL = "–"


def cell_html(value: Cell) -> Markup:
    """Return the HTML of a table cell; a number has its full precision in an attribute."""
    if value is None:
        return Markup(NOT_IN_MODEL)
    if isinstance(value, str):
        return escape(value)
    return Markup('<data value="{}">{}</data>').format(repr(float(value)), number(value))


@dataclass(frozen=True)
class Table:
    """Table of a report.

    Parameters
    ----------
    title
        Caption.
    columns
        Column headers. The first column names the row.
    rows
        Cells of each row: text (escaped unless it is ``Markup``), numbers (shown with five significant digits, stored
        in full), or None for values that a model does not have.
    groups
        Headers of groups of columns, as (text, number of columns) from left to right; empty text gives no header.
    headings
        Headings across the table, by the index of the row below each.
    note
        Sentence below the table.
    wrap
        Whether text in cells is wrapped; otherwise every row is one line.
    stacked
        Whether the cells of a row are placed below one another on narrow screens.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    groups: Sequence[tuple[str, int]] = ()
    headings: Mapping[int, str] = field(default_factory=dict)
    note: str = ""
    wrap: bool = False
    stacked: bool = False

    @classmethod
    def from_groups(
        cls, title: str, columns: Sequence[str], rows: Mapping[str, Sequence[Sequence[Cell]]], **options: Any
    ) -> Table:
        """Return a table from rows by heading, with the options of the class."""
        starts = accumulate((len(each) for each in rows.values()), initial=0)
        flat = [row for each in rows.values() for row in each]
        return cls(title, columns, flat, headings=dict(zip(starts, rows, strict=False)), **options)

    @property
    def is_numeric(self) -> list[bool]:
        """Whether each column is numeric, and therefore right-aligned."""
        columns = [[row[k] for row in self.rows] for k in range(len(self.columns))]
        return [
            bool(cells)
            and all(c is None or not isinstance(c, str) for c in cells)
            and any(c is not None for c in cells)
            for cells in columns
        ]

    @property
    def starts_group(self) -> list[bool]:
        """Whether each column is the first of its group."""
        starts, at = [False] * len(self.columns), 0
        for text, width in self.groups:
            if text and at < len(starts):
                starts[at] = True
            at += width
        return starts

    def to_html(self) -> Markup:
        """Return the table as HTML, in a container that scrolls horizontally on narrow screens."""
        pairs = zip(self.is_numeric, self.starts_group, strict=True)
        words = [" ".join(w for w, on in (("n", numeric), ("g", group)) if on) for numeric, group in pairs]
        classes = [Markup(' class="{}"').format(w) if w else "" for w in words]
        kind = " dense" if len(self.columns) >= DENSE_MIN_COLUMNS else " wrap" if self.wrap else ""
        kind += " stacked" if self.stacked else ""
        template = templates("ftlm.svg").get_template("table.html.j2")
        return Markup(template.render(table=self, classes=classes, kind=kind))  # the template escapes


@dataclass(frozen=True)
class Section:
    """Section of a report.

    Parameters
    ----------
    heading
        Heading.
    paragraphs
        Text, escaped unless it is ``Markup``.
    warnings
        Warnings in a box at the top.
    tables, figures
        See :class:`ftlm.report.Table` and ``line_figure``.
    small
        Whether two figures are placed side by side on wide screens.
    more
        Further warnings in a collapsed list.
    fold
        Title of the collapsed part; it is open in print.
    folded_tables
        Tables of the collapsed part.
    collapsed
        Whether only the heading is shown until it is clicked; the section is open in print.
    """

    heading: str
    paragraphs: Sequence[str] = ()
    warnings: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    small: bool = False
    more: Sequence[str] = ()
    fold: str = "Numbers"
    folded_tables: Sequence[Table] = ()
    collapsed: bool = False

    def __post_init__(self) -> None:
        # A str is a sequence of characters; treat it as one paragraph.
        for name in ("paragraphs", "warnings", "more"):
            if isinstance(getattr(self, name), str):
                object.__setattr__(self, name, (getattr(self, name),))


@cache
def templates(package: str) -> Environment:
    """Templates of HTML in the files of a package; what they insert is escaped unless it is ``Markup``."""
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=FunctionLoader(lambda name: read_resource(name, package)),
    )
    environment.filters |= {"cell": cell_html, "number": number}
    return environment


@cache
def read_resource(name: str, package: str = "ftlm.svg") -> str:
    """Return the text of a file of a package."""
    return resources.files(package).joinpath(name).read_text("utf-8")


def style_sheet() -> Markup:
    """Return the style sheet of all pages."""
    return Markup(read_resource("style.css"))  # our own file


@cache
def _script() -> tuple[Markup, str]:
    """Return the script element and its hash for the content security policy."""
    text = read_resource("charts.js")
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return Markup(text), f"sha256-{digest}"  # our own file


def write_page(
    path: str | os.PathLike[str],
    *,
    title: str,
    sections: Sequence[Section],
    lead: str = "",
    force: bool = False,
    verdict: str = "",
) -> Path:
    """Write sections to an HTML file, and return its path.

    Parameters
    ----------
    path
        File to write.
    title
        Title.
    sections
        Sections in order.
    lead
        Summary below the title.
    force
        Overwrite an existing file.
    verdict
        Content above everything else, escaped unless it is ``Markup``.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ModelError
        If the file name does not end in .html.
    DataError
        If the file exists and ``force`` is False, or it cannot be written.
    """
    check_ending(path, ".html")
    script, digest = _script()
    page = (
        templates("ftlm.svg")
        .get_template("page.html.j2")
        .render(
            title=title,
            lead=lead,
            sections=list(sections),
            version=__version__,
            look=style_sheet(),
            chart_css=chart_css(),
            script=script,
            script_hash=digest,
            verdict=verdict,
        )
    )
    # A name may hold half a surrogate pair, which no file can.
    return write_atomically(path, page.encode("utf-8", "backslashreplace"), force=force)


@dataclass(frozen=True)
class Page:
    """Content of a page: title, sections and summary."""

    title: str
    sections: Sequence[Section]
    lead: str


class ReportMixin(ABC):
    """Mixin class of results that can write an HTML report."""

    @abstractmethod
    def _page(self) -> Page:
        """Return the content of the report."""

    def report(self, path: str | os.PathLike[str], *, force: bool = False) -> Path:
        """Write the result to an HTML file, with the arguments and errors of :meth:`ftlm.Identification.report`."""
        page = self._page()
        return write_page(path, title=page.title, sections=page.sections, lead=page.lead, force=force)
