"""Minus signs of negative numbers in the prose of the pages; code keeps the hyphens that readers copy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from docutils import nodes
from sphinx import addnodes
from sphinx.transforms import SphinxTransform

from ftlm.utils.formatting import with_minus_signs

if TYPE_CHECKING:
    from sphinx.application import Sphinx

CODE = (nodes.literal, nodes.literal_block, nodes.doctest_block, nodes.math, nodes.math_block, nodes.raw)


class MinusSigns(SphinxTransform):
    """Replacement of hyphens before digits by minus signs, in text that is neither code nor a signature."""

    default_priority = 900

    def apply(self, **_: Any) -> None:
        """Replace the text nodes of a page."""
        for node in list(self.document.findall(nodes.Text)):
            written = with_minus_signs(node.astext())
            if written != node.astext() and not is_code(node):
                node.parent.replace(node, nodes.Text(written))


def is_code(node: nodes.Node | None) -> bool:
    """Return whether a node is part of code, a formula or a signature."""
    while node is not None:
        if isinstance(node, (*CODE, addnodes.desc_signature)):
            return True
        node = node.parent
    return False


def setup(app: Sphinx) -> None:
    """Register the transform."""
    app.add_transform(MinusSigns)
