"""A figure, and the pieces of SVG that every drawing has."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, field

from markupsafe import Markup

#: Width of the drawing for telephones; its text stays as large as the wide one's.
NARROW = 360
#: Width of charts that stand side by side.
SMALL = 520
#: Text at 12 px: width of a letter, height of a line.
LETTER, LINE = 6.7, 15


@dataclass(frozen=True)
class Figure:
    """A chart of a report; `line_chart` makes them.

    Parameters
    ----------
    title
        What is shown.
    svg
        The drawing, trusted markup.
    narrow
        The same for narrow screens, or empty.
    caption
        What the eye cannot see in the drawing, such as values that are not finite.
    """

    title: str
    svg: Markup
    narrow: Markup = field(default_factory=Markup)
    caption: str = ""

    def _repr_html_(self) -> str:
        return str(
            Markup("<figure>{}<figcaption>{}. {}</figcaption></figure>").format(self.svg, self.title, self.caption)
        )


class Figures(tuple[Figure, ...]):
    """Charts that belong together: a notebook shows them, :func:`print` names them."""

    __slots__ = ()

    def __str__(self) -> str:
        return "\n".join(figure.title for figure in self)

    def _repr_html_(self) -> str:
        return "".join(figure._repr_html_() for figure in self)


def svg(
    width: int, height: int, title: str, described: str, parts: Iterable[Markup], *, narrow: bool,
    attributes: str = "",
) -> Markup:  # fmt: skip
    """A whole drawing with what is said of it to those who listen."""
    return Markup(
        '<svg class="chart {}" role="img" viewBox="0 0 {} {}" width="{}" height="{}"{}>'
        "<title>{}</title><desc>{}</desc>{}</svg>"
    ).format(
        "narrow" if narrow else "wide", width, height, width, height, attributes, title, described,
        Markup("").join(parts),
    )  # fmt: skip


def svg_text(x: float, y: float, text: str, anchor: str) -> Markup:
    """A word whose start, middle or end is at a place."""
    return Markup('<text x="{:.1f}" y="{:.1f}" text-anchor="{}">{}</text>').format(x, y, anchor, text)


def text_width(text: str) -> float:
    """Width in pixels, more or less."""
    return LETTER * sum(2 if unicodedata.east_asian_width(c) in "WF" else 1 for c in text)
