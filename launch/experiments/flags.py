"""Read from a bag which errors of the scene the nodes suspected during the recording."""

from __future__ import annotations

from pathlib import Path

from flexsheet.messages.bag import BagReader
from flexsheet.messages.types import Status, SuspectedCause


def read_flags(bag: Path) -> list[SuspectedCause]:
    """Return the causes that nodes suspected, each once, in the order of first occurrence."""
    found: dict[SuspectedCause, None] = {}
    for _, message, _, _ in BagReader(bag, topics=["status"]):
        if isinstance(message, Status):
            found.update({check.cause: None for check in message.self_checks if check.suspected})
    return list(found)
