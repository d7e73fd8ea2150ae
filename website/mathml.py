"""Formulas for the site: a Markdown extension that turns $...$ and $$...$$ into MathML.

Browsers draw MathML themselves, so a page needs no script and no font from elsewhere.  The same
source is drawn by hosts of repositories, which know the dollar signs, too.
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
"""A dollar sign that hugs its formula on both sides, so that prices and shells are left alone."""

AFTER_CODE, BEFORE_ESCAPES = 190, 185
"""Priorities of Python-Markdown: code spans come first, backslashes are still there."""


PRIME = re.compile(r"<msup>(<m[in]>[^<]*</m[in]>)<mi>&#x02032;</mi></msup>")
"""A prime is drawn high already; raised once more it would stand above the line."""


def mathml(formula: str, display: Literal["inline", "block"]) -> str:
    """A formula of LaTeX."""
    return PRIME.sub(r"<mrow>\1<mo>&#x02032;</mo></mrow>", convert(formula, display=display))


class InlineFormula(InlineProcessor):
    """$a^2$ within a line."""

    def handleMatch(self, m: re.Match[str], data: str) -> tuple[str, int, int]:
        return self.md.htmlStash.store(mathml(m.group(1), "inline")), m.start(0), m.end(0)


class FormulaBlock(BlockProcessor):
    """A paragraph that begins and ends with two dollar signs."""

    def test(self, parent: Element, block: str) -> bool:
        return block.startswith("$$") and block.rstrip().endswith("$$") and len(block.strip()) > 4

    def run(self, parent: Element, blocks: list[str]) -> None:
        formula = mathml(blocks.pop(0).strip().strip("$").strip(), "block")
        place = SubElement(parent, "div", {"class": "formula"})
        place.text = self.parser.md.htmlStash.store(formula)


class MathMLExtension(Extension):
    """Both of them."""

    def extendMarkdown(self, md: Markdown) -> None:
        md.inlinePatterns.register(InlineFormula(INLINE, md), "mathml", BEFORE_ESCAPES)
        md.parser.blockprocessors.register(FormulaBlock(md.parser), "mathml", AFTER_CODE)


def makeExtension(**options: Any) -> MathMLExtension:
    """By this name Python-Markdown finds an extension."""
    return MathMLExtension(**options)
