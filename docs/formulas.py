"""Formulas of the pages as SVG by matplotlib's mathtext, without scripts and network, in the color of the text."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any

from docutils.nodes import SkipNode
from matplotlib.font_manager import FontProperties
from matplotlib.path import Path
from matplotlib.textpath import TextPath, text_to_path

if TYPE_CHECKING:
    from docutils import nodes
    from sphinx.application import Sphinx
    from sphinx.writers.html5 import HTML5Translator

#: Size of a drawing [points], in whose units it is made; the page scales it to that of its text.
SIZE_PT = 10.0
#: Height of a lower-case letter of the formulas over that of the page's text.
SCALE = 1.0
#: Tokens of a formula: a command or a single character.
TOKEN = re.compile(r"\\(?:[A-Za-z]+|.)|\S")
OPENING, CLOSING = ("{", "(", "[", r"\left"), ("}", ")", "]", r"\right")
BREAK_AFTER = (
    "=",
    "<",
    ">",
    *(rf"\{name}" for name in ("leq", "geq", "approx", "equiv", "in", "to", "mapsto", "quad")),
)
COMMANDS = {Path.MOVETO: "M", Path.LINETO: "L", Path.CURVE3: "Q", Path.CURVE4: "C", Path.CLOSEPOLY: "Z"}


def split_at_breaks(formula: str) -> list[str]:
    """Return the parts of a formula between which a line may break: after relations and signs outside brackets."""
    found, depth, begin, last = [], 0, 0, ""
    for token in TOKEN.finditer(formula):
        text = token.group()
        depth += (text in OPENING) - (text in CLOSING)
        is_sign = text in "+-" and last not in ("^", "_") and formula[begin : token.start()].strip()
        if not depth and (text in BREAK_AFTER or is_sign):
            found.append(formula[begin : token.end()])
            begin = token.end()
        last = text
    return [part for part in (*found, formula[begin:]) if part.strip()]


def draw(formula: str) -> str:
    """Return a formula as a sequence of SVG drawings, between which a line may break."""
    return "".join(draw_part(part) for part in split_at_breaks(" ".join(formula.split())))


@cache
def draw_part(formula: str) -> str:
    """Return a part of a formula as one SVG drawing, aligned with the baseline of the text."""
    font = FontProperties(size=SIZE_PT, math_fontfamily="dejavuserif")
    text = f"${formula}$"
    # The path is computed from the same parse, which takes most of the time.
    width, height, depth = text_to_path.get_text_width_height_descent(text, font, ismath=True)
    path = TextPath((0, 0), text, size=SIZE_PT, prop=font)
    drawn = "".join(
        # SVG counts downwards.
        COMMANDS[code] + ("" if code == Path.CLOSEPOLY else " ".join(f"{v * (-1) ** k:.2f}" for k, v in enumerate(at)))
        for at, code in path.iter_segments(curves=True, simplify=False)
    )
    unit = SCALE / SIZE_PT
    whole = height + depth
    style = f"width:{width * unit:.3f}em;height:{whole * unit:.3f}em;vertical-align:{-depth * unit:.3f}em"
    return (
        f'<svg class="formula" role="img" aria-label="{html.escape(formula, quote=True)}" style="{style}" '
        f'viewBox="0 {depth - whole:.2f} {width:.2f} {whole:.2f}"><path fill="currentColor" d="{drawn}"/></svg>'
    )


def in_line(self: HTML5Translator, node: nodes.math) -> None:
    """Write a formula in a line of text."""
    self.body.append(draw(node.astext()))


def in_block(self: HTML5Translator, node: nodes.math_block) -> None:
    """Write formulas in a block of their own, one formula per line."""
    lines = "<br/>".join(draw(part) for part in node.astext().replace("\\frac", "\\dfrac").split("\\\\"))
    self.body.append(f'<div class="formula">{lines}</div>')


def setup(app: Sphinx) -> None:
    """Register the drawings as a math renderer of Sphinx."""

    def visit(write: Callable[[HTML5Translator, Any], None]) -> Callable[[HTML5Translator, Any], None]:
        def write_and_skip(self: HTML5Translator, node: Any) -> None:
            write(self, node)
            raise SkipNode

        return write_and_skip

    app.add_html_math_renderer("drawn", (visit(in_line), None), (visit(in_block), None))
