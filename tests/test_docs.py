"""Test the links of the documentation, and that the navigation contains each page."""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from flexsheet.launch.plans.plan import load_graph
from tests.doc_pages import (
    DOCS,
    ROOT,
    anchors,
    as_built,
    count_words,
    headings,
    links,
    name,
    nav_pages,
    pages,
    prose,
    site_docs,
    site_pages,
)
from website.finish import NetworkError, finish
from website.pages import CHARTS, INCLUDE, TABLES, drawings

NO_NODES = {"light", "projector"}
"""The labels in the drawings of the graph that are no nodes and topics."""

START = DOCS / "index.md"

MAX_PAGE_WORDS = 900
MAX_README_WORDS = 450
MAX_WORDS = 30_000
PURPOSE = re.compile(r"This (page|tutorial|guide) ")


def targets(page: Path) -> set[Path]:
    """Return the pages of the site that a page links to."""
    all_links = links(as_built(page))
    found = ((page.parent / link.target.partition("#")[0]).resolve() for link in all_links)
    return {target for target in found if target.suffix == ".md" and DOCS in target.parents}


def test_each_page_is_in_the_navigation_once() -> None:
    listed = Counter(nav_pages())
    assert set(listed) == {str(page.relative_to(DOCS)) for page in site_pages()}, (
        "nav in zensical.toml and docs/ differ; add the page where a reader would look for it"
    )
    assert set(listed.values()) == {1}


@pytest.mark.parametrize("page", pages(), ids=name)
def test_links_anchors_and_images_are_there(page: Path) -> None:
    for link in links(as_built(page)):
        if link.target.startswith(("http://", "https://")):
            continue
        file, _, anchor = link.target.partition("#")
        target = (page.parent / file).resolve() if file else page
        assert target.is_relative_to(ROOT), f"{link.place}: {link.target} is out of the project"
        is_chart = target.parent == CHARTS and target.with_suffix(".json").is_file()
        assert target.is_file() or is_chart, f"{link.place}: there is no file {link.target}"
        if link.is_picture:
            assert target.suffix in (".png", ".svg", ".webp"), (
                f"{link.place}: {link.target} is no picture"
            )
        if anchor:
            assert anchor in anchors(as_built(target)), (
                f"{link.place}: {link.target} meets no heading; words without signs make anchors "
                "that are the same everywhere"
            )


@pytest.mark.parametrize("page", site_pages(), ids=name)
def test_a_page_has_one_title(page: Path) -> None:
    lines = page.read_text().splitlines()
    assert lines[0].startswith("# "), f"{name(page)} does not begin with its title"
    assert headings(page)


@pytest.mark.parametrize("page", site_pages(), ids=name)
def test_a_page_is_short_and_begins_with_its_purpose(page: Path) -> None:
    assert count_words(page) <= MAX_PAGE_WORDS
    first = next(line for _, line in prose(page)[1:] if line.strip())
    assert PURPOSE.match(first), f"{name(page)}: begin with: This page describes ..."


def test_the_documentation_is_short() -> None:
    assert count_words(ROOT / "README.md") <= MAX_README_WORDS
    by_hand = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *site_pages()]
    assert sum(map(count_words, by_hand)) <= MAX_WORDS


def test_make_help_lists_the_targets_that_the_readme_names() -> None:
    listed = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True)
    targets = {line.split()[0] for line in listed.stdout.splitlines()}
    assert set(re.findall(r"make ([a-z-]+)", (ROOT / "README.md").read_text())) <= targets


def test_drawings_are_up_to_date() -> None:
    stale = [str(path) for path, text in drawings().items() if (DOCS / path).read_text() != text]
    assert stale == [], "run: make pages"


def test_generated_tables_contain_nothing_of_the_machine() -> None:
    for page in site_docs().rglob("*.md"):
        text = page.read_text()
        for wrong in ("<!-- include:", "PydanticUndefined", str(ROOT), str(Path.home()) + "/"):
            assert wrong not in text, f"{name(page)} contains {wrong}"


def test_pages_need_no_development_packages() -> None:
    """`make docs` works after `make setup`, which installs no packages for tests."""
    program = (
        "import sys; sys.modules.update(dict.fromkeys(('pytest', 'hypothesis', 'skfem')));"
        "import website.pages"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT)


@pytest.mark.parametrize("table", sorted(TABLES))
def test_a_page_with_a_generated_table_names_the_command_that_prints_it(table: str) -> None:
    commands = {
        "commands": "flexsheet --help",
        "message-types": "flexsheet topic info TOPIC",
        "parameters": "flexsheet node info TYPE",
        "scene-keys": "flexsheet scene",
        "topics": "flexsheet topic list --all",
    }
    (page,) = (
        text for one in DOCS.glob("*.md") if table in INCLUDE.findall(text := one.read_text())
    )
    assert f"`{commands.get(table, f'python -m website.pages {table}')}`" in page


def test_all_pages_are_linked_from_a_page_of_the_site() -> None:
    linked = {target for page in site_pages() for target in targets(page) - {page}}
    assert set(site_pages()) - linked <= {START}


@pytest.mark.parametrize(("drawing", "file"), [("graph", "lab.yaml"), ("graph-twin", "demo.yaml")])
def test_drawings_of_the_graph_show_only_nodes_and_topics_that_exist(
    drawing: str, file: str
) -> None:
    plan = load_graph(ROOT / "launch" / file, record=Path("bag.mcap"), needed=["twin/eye"])
    drawn = (DOCS / f"images/{drawing}.svg").read_text()
    labels = re.findall(r"<text[^>]*>([^<]+)</text>", drawn)
    names = {name for one in labels for name in one.split(", ") if re.fullmatch("[a-z_/]+", name)}
    assert names - NO_NODES <= plan.nodes.keys() | plan.writers.keys()


def test_links_out_of_the_site_lead_to_copies(tmp_path: Path) -> None:
    site, project = tmp_path / "site", tmp_path / "project"
    (site / "charts").mkdir(parents=True)
    (project / "launch").mkdir(parents=True)
    (project / "launch" / "lab.yaml").write_text("nodes: {}")
    (site / "a.html").write_text('<a href="../launch/lab.yaml"></a><a href="b.html"></a>')
    (site / "charts" / "b.html").write_text(
        '<a href="../../launch/lab.yaml"></a><a href="../a.html"></a>'
    )
    assert finish(site, project) == ["launch/lab.yaml"]
    first, second = ((site / page).read_text() for page in ("a.html", "charts/b.html"))
    assert first == '<a href="project/launch/lab.yaml.txt"></a><a href="b.html"></a>'
    assert second == '<a href="../project/launch/lab.yaml.txt"></a><a href="../a.html"></a>'
    assert (site / "project" / "launch" / "lab.yaml.txt").read_text() == "nodes: {}"


def test_nothing_of_the_site_comes_from_the_network(tmp_path: Path) -> None:
    page = tmp_path / "a.html"
    page.write_text('<script src="https://unpkg.com/iframe-worker/shim"></script>')
    finish(tmp_path, tmp_path)
    assert page.read_text() == '<script src="search-from-files.js"></script>'
    page.write_text('<link rel="stylesheet" href="https://fonts.example/a.css">')
    with pytest.raises(NetworkError, match="fonts"):
        finish(tmp_path, tmp_path)
