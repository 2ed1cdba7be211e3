"""HTML pages of reports with their sections and tables, from plain data."""

from __future__ import annotations

import base64
import hashlib
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import resources
from itertools import accumulate
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from ftlm._core import __version__
from ftlm.svg.figure import Figure
from ftlm.svg.line_chart import chart_css
from ftlm.utils.files import check_ending, write_atomically
from ftlm.utils.formatting import Cell, number, typeset
from ftlm.utils.parameters import use_interface

#: Minimum number of columns of a table that is set in small type. A table of the paper has fifteen columns, which must
#: fit a laptop screen.
DENSE_MIN_COLUMNS = 12
#: Minimum number of columns of a table whose rows become blocks on narrow screens. Three columns fit a phone.
STACKED_MIN_COLUMNS = 4
NOT_IN_MODEL = "–"


def cell_html(value: Cell) -> Markup:
    """Return the HTML content of a table cell.

    A number is shown rounded, and an HTML attribute contains it in full precision.
    """
    if value is None:
        return Markup(NOT_IN_MODEL)
    if isinstance(value, str):
        return typeset(value)
    return Markup('<data value="{}">{}</data>').format(repr(float(value)), number(value))


@dataclass(frozen=True)
class Table:
    """Table of a report.

    Parameters
    ----------
    title
        Title above the table.
    columns
        Column headers. The first column has the names of the rows.
    rows
        Cells of each row: text (escaped, with exponents as superscripts, unless it is ``Markup``), numbers (shown with
        five significant digits, stored in full), or None for values that a model does not have.
    groups
        (text, number of columns) of each header over a group of columns, from left to right. Empty text gives no
        header.
    headings
        Headings over the whole width of the table, by the index of the row that follows the heading.
    note
        Text below the table.
    wrap
        Whether text in cells is wrapped; otherwise every row has one line.
    stacked
        Whether each row becomes a block of cells with their heads on narrow screens, also with few columns.
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
        """Return a table whose rows are grouped under headings.

        `rows` are the rows by heading, and `options` are further arguments of the class.
        """
        starts = accumulate((len(group_rows) for group_rows in rows.values()), initial=0)
        flat = [row for group_rows in rows.values() for row in group_rows]
        return cls(title, columns, flat, headings=dict(zip(starts, rows, strict=False)), **options)

    @property
    def is_numeric(self) -> list[bool]:
        """For each column, whether it has numbers only. Numeric columns are right-aligned."""
        columns = [[row[k] for row in self.rows] for k in range(len(self.columns))]
        return [
            bool(cells)
            and all(c is None or not isinstance(c, str) for c in cells)
            and any(c is not None for c in cells)
            for cells in columns
        ]

    @property
    def starts_group(self) -> list[bool]:
        """For each column, whether it is the first column of a group with a header."""
        starts, column = [False] * len(self.columns), 0
        for text, width in self.groups:
            if text and column < len(starts):
                starts[column] = True
            column += width
        return starts

    @property
    def is_stacked(self) -> bool:
        """Whether each row becomes a block of cells with their heads on narrow screens."""
        return self.stacked or len(self.columns) >= STACKED_MIN_COLUMNS

    @property
    def heads(self) -> list[str]:
        """Plain column headers, after the header of their group."""
        groups = [text for text, width in self.groups for _ in range(width)] or [""] * len(self.columns)
        pairs = zip(groups, self.columns, strict=True)
        return [" ".join(Markup(part).striptags() for part in pair if part) for pair in pairs]

    def split(self, column: int) -> tuple[Table, Table]:
        """Return two tables, split before the column with index `column`; both have the names of the rows."""
        ends = list(accumulate(width for _, width in self.groups))
        group = ends.index(column) + 1 if ends else 0
        left = replace(
            self, columns=self.columns[:column], rows=[row[:column] for row in self.rows], groups=self.groups[:group]
        )
        right = replace(
            self,
            columns=[self.columns[0], *self.columns[column:]],
            rows=[[row[0], *row[column:]] for row in self.rows],
            groups=[("", 1), *self.groups[group:]] if ends else (),
        )
        return left, right

    def to_html(self) -> Markup:
        """Return the table as HTML, in a container that scrolls horizontally on narrow screens."""
        pairs = zip(self.is_numeric, self.starts_group, strict=True)
        class_names = [
            " ".join(w for w, is_set in (("n", numeric), ("g", group)) if is_set) for numeric, group in pairs
        ]
        classes = [Markup(' class="{}"').format(w) if w else "" for w in class_names]
        kind = " dense" if len(self.columns) >= DENSE_MIN_COLUMNS else " wrap" if self.wrap else ""
        kind += " stacked" if self.is_stacked else ""
        template = templates("ftlm.svg").get_template("table.html.j2")
        return Markup(template.render(table=self, classes=classes, kind=kind))  # safe: the template escapes all text


@dataclass(frozen=True)
class Section:
    """Section of a report.

    Parameters
    ----------
    heading
        Heading of the section.
    paragraphs
        Paragraphs of text, typeset as cells of a table.
    warnings
        Warnings that are shown in a box at the top.
    tables, figures
        Tables and charts of the section.
    small
        Whether two figures are placed side by side on wide screens.
    more
        Further warnings in a collapsed list.
    verdict
        Verdicts below the heading, escaped unless they are ``Markup``.
    fold
        Title of a collapsed part of the section, which is expanded in print.
    folded_tables
        Tables of this collapsed part.
    collapsed
        Whether only the heading is shown until it is clicked; the section is expanded in print.
    """

    heading: str
    paragraphs: Sequence[str] = ()
    warnings: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    small: bool = False
    more: Sequence[str] = ()
    verdict: str = ""
    fold: str = "Numbers"
    folded_tables: Sequence[Table] = ()
    collapsed: bool = False

    def __post_init__(self) -> None:
        # A str is a sequence of characters, but is treated as a single paragraph.
        for name in ("paragraphs", "warnings", "more"):
            if isinstance(getattr(self, name), str):
                object.__setattr__(self, name, (getattr(self, name),))


@cache
def templates(package: str) -> Environment:
    """Return the Jinja environment with the HTML templates of a package.

    Inserted text is escaped unless it is ``Markup``. The filter ``typeset`` also turns exponents into superscripts.
    """
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=FunctionLoader(lambda name: read_resource(name, package)),
    )
    environment.filters |= {"cell": cell_html, "number": number, "typeset": typeset}
    return environment


@cache
def read_resource(name: str, package: str = "ftlm.svg") -> str:
    """Return the text of the file `name` of a package."""
    return resources.files(package).joinpath(name).read_text("utf-8")


def style_sheet() -> Markup:
    """Return the CSS style sheet of all pages."""
    return Markup(read_resource("style.css"))  # safe: a file of this package


@cache
def _script() -> tuple[Markup, str]:
    """Return the text of the page script, and its hash for the content security policy."""
    text = read_resource("charts.js")
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return Markup(text), f"sha256-{digest}"  # safe: a file of this package


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
        Title of the page.
    sections
        Sections from top to bottom.
    lead
        Summary below the title.
    force
        Whether an existing file is overwritten.
    verdict
        Content at the top of the page, escaped unless it is ``Markup``.

    Returns
    -------
    Path
        The file that was written.

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
    # A name may contain an unpaired surrogate, which UTF-8 cannot encode.
    return write_atomically(path, page.encode("utf-8", "backslashreplace"), force=force)


@dataclass(frozen=True)
class Page:
    """Content of a report page: title, sections, summary below the title (`lead`), and verdict at the top."""

    title: str
    sections: Sequence[Section]
    lead: str
    verdict: str = ""

    def write(self, path: str | os.PathLike[str], *, force: bool = False) -> Path:
        """Write the page to an HTML file, and return its path; see :func:`write_page`."""
        return write_page(path, force=force, **vars(self))


class ReportMixin(ABC):
    """Mixin class of results that can write an HTML report."""

    @abstractmethod
    def _page(self) -> Page:
        """Return the content of the report."""

    def report(self, path: str | os.PathLike[str], *, force: bool = False) -> Path:
        """Write the result to an HTML file, and return its path.

        Arguments and errors are those of :meth:`ftlm.Identification.report`.
        """
        with use_interface("report"):
            page = self._page()
        return page.write(path, force=force)
