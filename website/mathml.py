"""Markdown extension that converts the formulas $...$ and $$...$$ to MathML.

Browsers render MathML without scripts or fonts from the network.  Repository hosts render the same
source.
"""

from __future__ import annotations

import re
from typing import Any, Literal
from xml.etree.ElementTree import Element, SubElement

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.blockprocessors import BlockProcessor
from markdown.extensions import Extension
from markdown.inlinepatterns import InlineProcessor

INLINE = r"(?<![\\$\w])\$(?=[^\s$])([^$\n]*[^\s$\\])\$(?![\w$])"
"""The pattern of a formula within a line.

No space is next to the dollar signs, which excludes prices and shell variables.
"""

AFTER_CODE, BEFORE_ESCAPES = 190, 185
"""Priorities in Python-Markdown: after code spans and before backslash escapes."""


PRIME = re.compile(r"<msup>(<m[in]>[^<]*</m[in]>)<mi>&#x02032;</mi></msup>")
"""The pattern of a superscript that contains a prime, which is a raised character already."""


def mathml(formula: str, display: Literal["inline", "block"]) -> str:
    """Convert a LaTeX formula to MathML."""
    return PRIME.sub(r"<mrow>\1<mo>&#x02032;</mo></mrow>", convert(formula, display=display))


class InlineFormula(InlineProcessor):
    """Processor of formulas within a line."""

    def handleMatch(self, m: re.Match[str], data: str) -> tuple[str, int, int]:
        return self.md.htmlStash.store(mathml(m.group(1), "inline")), m.start(0), m.end(0)


class FormulaBlock(BlockProcessor):
    """Processor of paragraphs that start and end with two dollar signs."""

    def test(self, parent: Element, block: str) -> bool:
        return block.startswith("$$") and block.rstrip().endswith("$$") and len(block.strip()) > 4

    def run(self, parent: Element, blocks: list[str]) -> None:
        formula = mathml(blocks.pop(0).strip().strip("$").strip(), "block")
        element = SubElement(parent, "div", {"class": "formula"})
        element.text = self.parser.md.htmlStash.store(formula)


class MathMLExtension(Extension):
    """An extension with both processors."""

    def extendMarkdown(self, md: Markdown) -> None:
        md.inlinePatterns.register(InlineFormula(INLINE, md), "mathml", BEFORE_ESCAPES)
        md.parser.blockprocessors.register(FormulaBlock(md.parser), "mathml", AFTER_CODE)


def makeExtension(**options: Any) -> MathMLExtension:
    """Create the extension; Python-Markdown calls this function by its name."""
    return MathMLExtension(**options)
