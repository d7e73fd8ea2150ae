"""Parse the documentation: pages, code blocks, headings and links."""

from __future__ import annotations

import os
import re
import tempfile
import tomllib
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from tests.shared import FOLDER_VARIABLE, compute_once
from website.pages import build

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
SITE = ROOT / "zensical.toml"

FENCE = re.compile(r"^( *)```(\S*)")
NOT_RUN = re.compile(r"<!-- not run: (.+) -->")
LINK = re.compile(r"(!?)\[(?:[^\]\[]|\[[^\]]*\])*\]\(([^)\s]+)\)")
CODE_SPAN = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")


@dataclass(frozen=True)
class Block:
    """A fenced block of code on a page.

    not_run: reason for not running the block, or None.
    """

    page: Path
    line: int
    language: str
    text: str
    not_run: str | None

    @property
    def place(self) -> str:
        return f"{name(self.page)}:{self.line}"


@dataclass(frozen=True)
class Link:
    page: Path
    line: int
    target: str
    is_picture: bool

    @property
    def place(self) -> str:
        return f"{name(self.page)}:{self.line}"


def name(page: Path) -> str:
    root = ROOT if page.is_relative_to(ROOT) else site_docs().parent
    return str(page.relative_to(root))


@cache
def site_docs() -> Path:
    """Return a folder docs/ with the generated tables, built once per run of the tests."""

    def build_once() -> str:
        folder = tempfile.mkdtemp(prefix="site-", dir=os.environ.get(FOLDER_VARIABLE))
        build(Path(folder, "docs"))
        return folder

    return Path(compute_once("site-docs", build_once), "docs")


def as_built(page: Path) -> Path:
    """Return the built version of a page of docs/. Other pages are returned unchanged."""
    return site_docs() / page.relative_to(DOCS) if page.is_relative_to(DOCS) else page


def site_pages() -> list[Path]:
    """Return the pages of the site, without the page that `make charts` writes."""
    return sorted(page for page in DOCS.rglob("*.md") if page.parent != DOCS / "charts")


def pages() -> list[Path]:
    """Return all pages for users."""
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *site_pages()]


def nav_pages() -> list[str]:
    """Return the files of the site's navigation, in order."""

    def walk(entry: Any) -> Iterator[str]:
        match entry:
            case str():
                yield entry
            case dict():
                for below in entry.values():
                    yield from walk(below)
            case list():
                for below in entry:
                    yield from walk(below)

    return list(walk(tomllib.loads(SITE.read_text())["project"]["nav"]))


def blocks(page: Path) -> list[Block]:
    """Return the fenced blocks of a page, with the reasons for not running them."""
    found: list[Block] = []
    indent, language, begun, inside = "", "", 0, None
    comment: str | None = None
    for number, line in enumerate(page.read_text().splitlines(), start=1):
        fence = FENCE.match(line)
        if inside is None:
            if fence:
                indent, language, begun, inside = fence[1], fence[2], number, []
            elif reason := NOT_RUN.search(line):
                comment = reason[1]
            elif line.strip():
                comment = None
        elif fence:
            text = "\n".join(inside) + "\n"
            found.append(Block(page, begun, language, text, comment))
            inside, comment = None, None
        else:
            inside.append(line.removeprefix(indent))
    assert inside is None, f"{name(page)}:{begun}: the block does not end"
    return found


def prose(page: Path) -> list[tuple[int, str]]:
    """Return the lines outside of blocks, with line numbers."""
    lines, inside = [], False
    for number, line in enumerate(page.read_text().splitlines(), start=1):
        if FENCE.match(line):
            inside = not inside
        elif not inside:
            lines.append((number, line))
    return lines


def count_words(page: Path) -> int:
    """Return the number of words outside of code blocks and comments."""
    text = re.sub(r"<!--.*?-->", "", "\n".join(line for _, line in prose(page)), flags=re.DOTALL)
    return sum(bool(re.search(r"\w", word)) for word in text.split())


def links(page: Path) -> list[Link]:
    """Return the links and images outside of code."""
    return [
        Link(page, number, match[2], is_picture=bool(match[1]))
        for number, line in prose(page)
        for match in LINK.finditer(CODE_SPAN.sub("", line))
    ]


def code_spans(page: Path) -> list[tuple[int, str]]:
    """Return the code spans within lines of text, with line numbers."""
    return [(number, span) for number, line in prose(page) for span in CODE_SPAN.findall(line)]


def headings(page: Path) -> list[str]:
    return [line.lstrip("#").strip() for _, line in prose(page) if re.match(r"#{1,6} ", line)]


def anchors(page: Path) -> set[str]:
    """Return the anchors that repository hosts and the generator of the site give to headings.

    Headings with different anchors are omitted.
    """
    found = set()
    for heading in headings(page):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "")
        there = re.sub(r"[^\w\- ]", "", words.lower()).replace(" ", "-")
        plain = unicodedata.normalize("NFKD", words).encode("ascii", "ignore").decode()
        here = re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", plain).strip().lower())
        if here == there:
            found.add(here)
    return found
