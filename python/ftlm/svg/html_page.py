"""A table: plain data first, and the HTML that is made of it."""

from __future__ import annotations

import base64
import hashlib
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path

from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup, escape

from ftlm._core import __version__
from ftlm.svg.figure import Figure
from ftlm.svg.line_chart import chart_css
from ftlm.utils.files import write_atomically
from ftlm.utils.formatting import Cell, number

#: Columns from which a table is set smaller, so that the paper's fifteen fit a laptop's screen.
DENSE = 12
NOT_IN_MODEL = "–"


def cell_html(value: Cell) -> Markup:
    """Return a cell's content; a number carries its full precision for whoever reads the page by program."""
    if value is None:
        return Markup(NOT_IN_MODEL)
    if isinstance(value, str):
        return escape(value)
    return Markup('<data value="{}">{}</data>').format(repr(float(value)), number(value))


@dataclass(frozen=True)
class Table:
    """A table of a report.

    Parameters
    ----------
    title
        Caption.
    columns
        Column heads. The first column names the row.
    rows
        Cells: text (escaped, unless it is ``Markup``), numbers (shown with five significant digits, kept in full), or
        None for what a model does not have.
    groups
        Heads above the heads, as (text, number of columns) from left to right; an empty text heads nothing.
    headings
        Lines across the table, by the index of the row that they stand above.
    note
        Sentence below the table.
    wrap
        Whether text in cells breaks into lines; otherwise every row is one line.
    stacked
        Whether the cells of a row, which wrap, stand below one another where the screen is narrow.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    groups: Sequence[tuple[str, int]] = ()
    headings: Mapping[int, str] = field(default_factory=dict)
    note: str = ""
    wrap: bool = False
    stacked: bool = False

    @property
    def is_numeric(self) -> list[bool]:
        """Which columns hold numbers, and are set flush right."""
        columns = [[row[k] for row in self.rows] for k in range(len(self.columns))]
        return [
            bool(cells)
            and all(c is None or not isinstance(c, str) for c in cells)
            and any(c is not None for c in cells)
            for cells in columns
        ]

    @property
    def starts_group(self) -> list[bool]:
        """Which columns begin a group, and are set apart."""
        starts, at = [False] * len(self.columns), 0
        for text, width in self.groups:
            if text and at < len(starts):
                starts[at] = True
            at += width
        return starts

    def _classes(self) -> list[str]:
        pairs = zip(self.is_numeric, self.starts_group, strict=True)
        return [" ".join(w for w, on in (("n", numeric), ("g", group)) if on) for numeric, group in pairs]

    def to_html(self) -> Markup:
        """Return the table in a container that scrolls by itself on a narrow screen."""
        classes = [Markup(' class="{}"').format(c) if c else Markup("") for c in self._classes()]
        # The title stands outside of what scrolls, so that it wraps; the label tells it to those who listen.
        dense = " dense" if len(self.columns) >= DENSE else " wrap" if self.wrap else ""
        dense += " stacked" if self.stacked else ""
        out = [Markup('<div class="table{}"><p class="title">{}</p>').format(dense, self.title)]
        out.append(Markup('<div class="scroll" role="group" tabindex="0" aria-label="{}">').format(self.title))
        out.append(Markup('<table aria-label="{}"><thead>').format(self.title))
        if self.groups:
            heads = Markup("").join(
                Markup('<th scope="colgroup" colspan="{}" class="g">{}</th>').format(width, text)
                if text
                else Markup('<td colspan="{}"></td>').format(width)
                for text, width in self.groups
            )
            out.append(Markup("<tr>{}</tr>").format(heads))
        heads = Markup("").join(
            Markup('<th scope="col"{}>{}</th>').format(c, head) for c, head in zip(classes, self.columns, strict=True)
        )
        out.append(Markup("<tr>{}</tr></thead><tbody>").format(heads))
        for i, row in enumerate(self.rows):
            if i in self.headings:
                out.append(
                    Markup('<tr class="heading"><th scope="rowgroup" colspan="{}"><span>{}</span></th></tr>').format(
                        len(self.columns), self.headings[i]
                    )
                )
            cells = [Markup('<th scope="row"{}>{}</th>').format(classes[0], cell_html(row[0]))]
            cells += [
                Markup("<td{}>{}</td>").format(c, cell_html(v)) for c, v in zip(classes[1:], row[1:], strict=True)
            ]
            out.append(Markup("<tr>{}</tr>").format(Markup("").join(cells)))
        out.append(Markup("</tbody></table></div>"))
        if self.note:
            out.append(Markup('<p class="note">{}</p>').format(self.note))
        out.append(Markup("</div>"))
        return Markup("\n").join(out)


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
    return environment.from_string(resources.files("ftlm.svg").joinpath("page.html.j2").read_text("utf-8"))


@cache
def look() -> Markup:
    """What all pages look alike in."""
    return Markup(resources.files("ftlm.svg").joinpath("style.css").read_text("utf-8"))  # our own file


@cache
def chart_script() -> str:
    """What makes charts zoom, and sliders read them out."""
    return resources.files("ftlm.svg").joinpath("charts.js").read_text("utf-8")


@cache
def _script() -> tuple[Markup, str]:
    """The script of the charts, and the hash under which the page allows it and nothing else."""
    text = chart_script()
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
        title=title,
        lead=lead,
        sections=list(sections),
        version=__version__,
        look=look(),
        chart_css=chart_css(),
        script=script,
        script_hash=digest,
        verdict=verdict,
    )
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
