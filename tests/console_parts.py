"""Provide messages, as values and as frames, for the tests of the console."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from flexsheet.messages.base import Header, Message
from flexsheet.messages.types import Status
from flexsheet.messages.wire import encode

ROOT = Path(__file__).resolve().parent.parent


class FixedMessages:
    """A message source whose messages the test sets."""

    def __init__(self, **messages: Message) -> None:
        self.held = {
            name.replace("__", "/"): (message, Header(1, 10_000_000, 13_000_000, "c", "w", 1))
            for name, message in messages.items()
        }

    def latest(self, name: str, kind: Any) -> Any:
        return self.held.get(name)


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
