"""What is said while a graph runs is on the page of errors, and so is what other pages quote."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from flexsheet.launch.reference.errors import explained
from tests.doc_pages import DOCS

QUOTING = ("troubleshooting", "security", "deploy", "clocks")
COMMANDS = r"flexsheet|python|make|cd|bag|arms|topic|node|apt|chronyc|journalctl"
PATH = r"\S*/"


@pytest.mark.parametrize(
    ("message", "kind", "page"),
    [
        ("NOT RECORDING: no room on the disk", "Note", "bags"),
        ("camera hung: no sign of life for 5 s; its log shows where", "Reason",
         "graph-and-processes"),
        ('topic "arm_left": host left refuses our key; is it the one in its launch file?',
         "Reason", "topics-and-messages"),
        ('topic "fingertip": 3 messages of triangulator lost, 5 in all; a reader or the network is '
         "too slow", "Warning", "topics-and-messages"),
        ("... may not reset an e-stop or let the arms move", "Reason", "graph-and-processes"),
        ("clock lab-1 is not measured", "Reason", "topics-and-messages"),
        ("arm poses 0.31 s old: keeping the last valid sheet plane", "Note",
         "renderer-and-projector"),
        ("e-stop of tools_left, kept until it is reset", "Warning", "graph-and-processes"),
        ("e-stop kept: ...", "Warning", "graph-and-processes"),
        ("no way: the edges do not say where the sheet is", "Reason", "arms"),
        ("watchdog: no command", "Reason", "arms"),
        ("left: no picture for 2 s: it hangs, or its cable or hub is overloaded", "Reason",
         "camera-and-calibration"),
        ("the window was closed and frames are not shown; restart the node to open it",
         "Note", "renderer-and-projector"),
        ("object is softer than the sheet presents surely", "Reason", "planner"),
    ],
)  # fmt: skip
def test_what_is_said_while_it_runs_is_explained(message: str, kind: str, page: str) -> None:
    first = explained(message)[0]
    assert (first["kind"], first["page"]) == (kind, f"docs/errors.md#{page}")
    assert first["what to do"]


def quoted(text: str) -> Iterator[str]:
    """Messages in a page: sentences in backticks that are no command, path, key or YAML, and what
    a table has in a column of what is said."""
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    for span in re.findall(r"`([^`\n]+)`", text):
        words = len(span.split())
        if words >= 3 and not re.match(rf"(?:{COMMANDS})\b|{PATH}|[A-Z:]+:|\S+:\s", span):
            yield span
    for table in re.findall(r"^\| said \|.*\n\|.*\n((?:\|.*\n)+)", text, flags=re.MULTILINE):
        for row in table.splitlines():
            yield from row.split("|")[1].strip().split("; ")


@pytest.mark.parametrize("page", QUOTING)
def test_what_pages_quote_is_explained(page: str) -> None:
    text = (DOCS / f"{page}.md").read_text()
    unknown = [message for message in quoted(text) if not explained(message)]
    assert unknown == [], f"docs/{page}.md quotes what the code does not say"


def test_quotes_are_found() -> None:
    found = {page: list(quoted((DOCS / f"{page}.md").read_text())) for page in QUOTING}
    assert "clock ... is known to ... only" in found["troubleshooting"]
    assert any(message.startswith("no way: left arm") for message in found["troubleshooting"])
    assert "accepts connections, but does not answer" in found["deploy"]
    assert any("is known to 7.1 ms only" in message for message in found["clocks"])
