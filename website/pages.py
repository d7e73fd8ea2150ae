"""Update measured figures and drawings, and write the input of the site's generator.

python -m website.pages        write the figures of pages, and the drawings of docs/images
python -m website.pages site   write build/docs: docs/ with all generated tables and charts
python -m website.pages NAME   print the entry NAME of `TABLES`

A line `<!-- include: NAME -->` of a page is replaced in the site by the entry NAME of `TABLES`.
"""

from __future__ import annotations

import re
import shutil
import signal
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from benchmarks import load, scenes, soft_body_size
from flexsheet.launch.methods import charts
from website import (
    apparatus_figure,
    arms_page,
    commands_page,
    figures,
    messages_page,
    parameters_page,
    sensitivity_page,
    system_page,
    tolerances_page,
    tracking_page,
)

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
CHARTS = DOCS / "charts"
RESULTS = DOCS / "results"
SITE_INPUT = ROOT / "build" / "docs"
INCLUDE = re.compile(r"^<!-- include: ([\w-]+) -->$", re.MULTILINE)

TABLES: Mapping[str, Callable[[], str]] = {
    "arm-states": arms_page.render_states,
    "charts": lambda: render_charts(CHARTS),
    "commands": commands_page.render,
    "errors": commands_page.render_errors,
    "load": lambda: load.render(RESULTS / "load.json"),
    "message-header": messages_page.render_header,
    "message-types": messages_page.render_types,
    "mxt-packet": arms_page.render_packet,
    "parameters": parameters_page.render,
    "registers": arms_page.render_registers,
    "ros2-topics": messages_page.render_ros2_topics,
    "scene-keys": messages_page.render_scene,
    "scenes": lambda: scenes.render(RESULTS / "scenes.json"),
    "sensitivity": lambda: sensitivity_page.render(RESULTS),
    "system": lambda: system_page.render_system(RESULTS),
    "tolerances": tolerances_page.render,
    "topics": messages_page.render_topics,
    "tracking-regret": lambda: tracking_page.render(CHARTS / "tracking-regret.json"),
}


def render_charts(folder: Path) -> str:
    """Return a section for each chart of docs/charts."""
    name = soft_body_size.NAME
    sections = charts.render_overview(folder, link_prefix="charts/")
    picture = f"![Time of an answer over the size of the body](charts/{name}.svg)"
    return f"{sections}\n## {name}\n\n{picture}\n\n[Numbers](charts/{name}.json).\n"


def drawings() -> dict[Path, str]:
    """Return the drawings that the repository contains, by their path relative to docs/."""
    return {Path("images") / "apparatus.svg": apparatus_figure.svg()}


def build(output: Path) -> None:
    """Write docs/ with its generated tables to a folder, which is replaced."""
    shutil.rmtree(output, ignore_errors=True)
    shutil.copytree(DOCS, output)
    for page in output.rglob("*.md"):
        text = figures.strip(page.read_text(encoding="utf-8"))
        page.write_text(INCLUDE.sub(lambda match: TABLES[match[1]](), text), encoding="utf-8")


def draw_charts(folder: Path) -> None:
    """Draw the charts of a folder from their results."""
    for result in charts.read_charts(folder):
        charts.write_chart(result, folder)
    soft_body_size.redraw(folder)


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # for `| head`
    if sys.argv[1:] == ["site"]:
        build(SITE_INPUT)
        draw_charts(SITE_INPUT / "charts")
    elif sys.argv[1:]:
        print(TABLES[sys.argv[1]]())
    else:
        for page in (ROOT / "README.md", *DOCS.glob("*.md")):
            page.write_text(figures.update(page.read_text(encoding="utf-8")), encoding="utf-8")
        for path, text in drawings().items():
            (DOCS / path).write_text(text, encoding="utf-8")
        system_page.draw(RESULTS, DOCS / "images")
