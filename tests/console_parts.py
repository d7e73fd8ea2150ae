"""Provide messages, as values and as frames, for the tests of the console."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from flexsheet.messages.base import Header, Message
from flexsheet.messages.types import Status
from flexsheet.messages.wire import encode
from flexsheet.nodes.console.latest_messages import LatestMessages

ROOT = Path(__file__).resolve().parent.parent


def status_of(node: str, **changes: Any) -> Status:
    """Return the status message of a running node."""
    values: dict[str, Any] = {
        "node": node,
        "state": "running",
        "pid": 1,
        "uptime_s": 1.0,
        "cpu_ratio": 0.25,
        "resident_bytes": 1,
        "inputs": (),
        "outputs": (),
        "errors": 0,
        "last_error": "",
        "plan_hash": "",
    }
    return Status(**values | changes)


def frames_of(message: Message, sequence: int = 1) -> tuple[list[Any], Header]:
    header = Header(sequence, 5, 6, "clock", "writer", 3)
    return encode(message, header), header


def latest_messages(**messages: Message) -> LatestMessages:
    """Return a store with a message of each named topic; "__" in a name stands for "/"."""
    store = LatestMessages(lambda topic, error: pytest.fail(f"{topic.name}: {error}"))
    for name, message in messages.items():
        store.put(name.replace("__", "/"), frames_of(message)[0])
    return store
