"""Store the latest message of each topic, and decode it on demand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from flexsheet.messages.base import Header, Message
from flexsheet.messages.topics import Topic, find_topic
from flexsheet.messages.wire import WireError, decode

M = TypeVar("M", bound=Message)


class MessageSource(Protocol):
    """Provide the messages that the page shows: of the running graph, or of a bag."""

    def latest(self, name: str, kind: type[M]) -> tuple[M, Header] | None:
        """Return the latest message of the topic with its header; None before the first."""
        ...


class LatestMessages:
    """Hold the latest message of each topic as frames, and decode it at the first access.

    refused: called with the topic and the error of a message that cannot be decoded.
    """

    def __init__(self, refused: Callable[[Topic, WireError], None]) -> None:
        self._frames: dict[str, Any] = {}
        self._opened: dict[str, tuple[Message, Header]] = {}
        self._refused = refused

    def put(self, name: str, frames: Any) -> bool:
        """Store the frames; return whether they replaced frames that nobody read."""
        unseen = name in self._frames
        self._frames[name] = frames
        return unseen

    def latest(self, name: str, kind: type[M]) -> tuple[M, Header] | None:
        """See `MessageSource`."""
        frames = self._frames.pop(name, None)
        if frames is not None:
            topic = find_topic(name)
            try:
                self._opened[name] = decode(frames, topic)
            except WireError as error:
                self._refused(topic, error)
        return check_type(self._opened.get(name), kind)


def check_type(entry: tuple[Message, Header] | None, kind: type[M]) -> tuple[M, Header] | None:
    """Return the entry with the type `kind`; TypeError for another type."""
    if entry is None:
        return None
    message, header = entry
    if not isinstance(message, kind):
        raise TypeError(f"{type(message).__name__} is not a {kind.__name__}")
    return message, header
