"""Mathematics as MathML, which browsers set by themselves: no script, no fonts, no network."""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

from latex2mathml.converter import convert

if TYPE_CHECKING:
    from docutils import nodes
    from sphinx.application import Sphinx
    from sphinx.writers.html import HTMLTranslator

LINES = "split"  # what an equation of several lines is set in


def setup(app: Sphinx) -> None:
    """Register the renderer under the name ``mathml``."""
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))


def mathml(source: str, display: bool = False) -> str:
    """The MathML of a formula in LaTeX; raises `ValueError` for a command that it does not know."""
    several = r"\\" in source and r"\begin" not in source
    text = rf"\begin{{{LINES}}}{source}\end{{{LINES}}}" if several else source
    made = convert(text, display="block" if display else "inline")
    try:
        words = "".join(ET.fromstring(made).itertext())
    except ET.ParseError:
        words = "\\"
    if "\\" in words:
        raise ValueError(f"a formula with a command that is not known: {source}")
    return made


def _inline(self: HTMLTranslator, node: nodes.math) -> None:
    from docutils import nodes

    self.body.append(f'<span class="math">{mathml(node.astext())}</span>')
    raise nodes.SkipNode


def _block(self: HTMLTranslator, node: nodes.math_block) -> None:
    from docutils import nodes

    self.body.append(self.starttag(node, "div", CLASS="math", STYLE="overflow-x: auto"))
    self.body.append(f"{mathml(node.astext(), display=True)}</div>\n")
    raise nodes.SkipNode
