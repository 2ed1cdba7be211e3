"""Tables on narrow screens: each row becomes a block whose cells repeat their column headers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from docutils import nodes
from sphinx.transforms.post_transforms import SphinxPostTransform

if TYPE_CHECKING:
    from sphinx.application import Sphinx

#: Minimum number of columns of a table that is stacked; tables with fewer columns fit a narrow screen.
STACKED_MIN_COLUMNS = 3
#: Length of the longest cell [characters] from which a column fills a whole line of the block.
LONG_CELL_CHARS = 20


class StackedRows(SphinxPostTransform):
    """Transform that copies the column headers into the cells of each row; pages.css shows them on narrow screens."""

    default_priority = 900
    formats = ("html",)

    def run(self, **_: Any) -> None:
        """Mark the tables of a page."""
        for table in self.document.findall(nodes.table):
            heads, *rows = ([*row.findall(nodes.entry)] for row in table.findall(nodes.row))
            if len(heads) < STACKED_MIN_COLUMNS or not table.next_node(nodes.thead) or len({*map(len, rows)}) > 1:
                # A table with few columns, without headers or with merged cells stays as it is.
                continue
            table["classes"].append("stacked")
            for head, *column in list(zip(heads, *rows, strict=True))[1:]:
                is_long = max((len(cell.astext()) for cell in column), default=0) >= LONG_CELL_CHARS
                for cell in column:
                    cell["classes"] += ["long"] * is_long + ["empty"] * (not cell.astext())
                    header_nodes = [child.deepcopy() for part in head.children for child in part.children]
                    cell.insert(0, nodes.paragraph("", "", *header_nodes, classes=["head"]))


def setup(app: Sphinx) -> None:
    """Register the transform."""
    app.add_post_transform(StackedRows)
