"""Test that the message reference agrees with the types."""

from __future__ import annotations

from flexsheet.messages.base import Header
from flexsheet.messages.topics import TOPICS
from website.messages_page import render_header, render_topics, render_types


def test_page_names_every_topic_type_and_field() -> None:
    page = render_topics() + render_header() + render_types()
    for topic in TOPICS.values():
        assert f"| `{topic.name}` | [{topic.message.__name__}]" in page
        assert f"### {topic.message.__name__}\n" in page
        for name in topic.message.model_fields:
            assert f"| `{name}` |" in page
    for name in Header.__slots__:
        line = next(line for line in page.splitlines() if line.startswith(f"| `{name}` |"))
        assert not line.endswith("|  |"), f"the header's {name} is not described"
