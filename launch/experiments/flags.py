"""Read which causes of a wrong scene the nodes suspected during a recording."""

from __future__ import annotations

from pathlib import Path

from flexsheet.messages.bag import BagReader
from flexsheet.messages.types import Status, SuspectedCause


def read_flags(bag: Path) -> list[SuspectedCause]:
    """Return the suspected causes of all nodes in a bag, each once, in the order of time."""
    found: dict[SuspectedCause, None] = {}
    for _, message, _, _ in BagReader(bag, topics=["status"]):
        if isinstance(message, Status):
            found.update({check.cause: None for check in message.self_checks if check.suspected})
    return list(found)
