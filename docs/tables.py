"""Tables of the pages on narrow screens: every row is a block whose cells state the heads of their columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from docutils import nodes
from sphinx.transforms.post_transforms import SphinxPostTransform

if TYPE_CHECKING:
    from sphinx.application import Sphinx

#: Tables of this many columns are stacked; fewer columns fit a telephone's screen side by side.
STACKED_MIN_COLUMNS = 3
#: Characters of the longest cell from which on a column takes a line of its own, not a share of one.
LONG_CELL_CHARS = 20


class StackedRows(SphinxPostTransform):
    """Copies of the heads of the columns in the cells of each row, which pages.css shows on narrow screens only."""

    default_priority = 900
    formats = ("html",)

    def run(self, **_: Any) -> None:
        """Mark the tables of a page."""
        for table in self.document.findall(nodes.table):
            heads, *rows = ([*row.findall(nodes.entry)] for row in table.findall(nodes.row))
            if len(heads) < STACKED_MIN_COLUMNS or not any(table.findall(nodes.thead)):
                continue
            table["classes"].append("stacked")
            for head, *column in list(zip(heads, *rows, strict=True))[1:]:
                is_long = max((len(cell.astext()) for cell in column), default=0) >= LONG_CELL_CHARS
                for cell in column:
                    cell["classes"] += ["long"] * is_long + ["empty"] * (not cell.astext())
                    written = [child.deepcopy() for part in head.children for child in part.children]
                    cell.insert(0, nodes.paragraph("", "", *written, classes=["head"]))


def setup(app: Sphinx) -> None:
    """Register the transform."""
    app.add_post_transform(StackedRows)
