"""Read which causes of a wrong belief the nodes reported during a recording."""

from __future__ import annotations

from pathlib import Path

from flexsheet.messages.bag import BagReader
from flexsheet.messages.types import Status

FLAGS_FIELD = "suspected_causes"
"""Field of `Status` with the causes that the self-checks suspect; absent where no node has any."""


def read_flags(bag: Path) -> list[str]:
    """Return the suspected causes of all nodes in a bag, each once, in the order of time."""
    found: dict[str, None] = {}
    for _, message, _, _ in BagReader(bag, topics=["status"]):
        if isinstance(message, Status):
            for cause in getattr(message, FLAGS_FIELD, ()):
                found[str(cause)] = None
    return list(found)
