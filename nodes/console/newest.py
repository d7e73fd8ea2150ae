"""What came last on each topic, opened only when somebody looks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from flexsheet.messages.base import Header, Message
from flexsheet.messages.topics import Topic, topic_named
from flexsheet.messages.wire import WireError, decode

M = TypeVar("M", bound=Message)


class Source(Protocol):
    """Where the page's picture comes from: the running graph, or a bag."""

    def newest(self, name: str, kind: type[M]) -> tuple[M, Header] | None:
        """The newest message of the topic with its header; None before the first."""
        ...


class Newest:
    """The newest message of each topic as frames, and opened once it was asked for.

    refused: told of a message whose bytes are not what they should be.
    """

    def __init__(self, refused: Callable[[Topic, WireError], None]) -> None:
        self._frames: dict[str, Any] = {}
        self._opened: dict[str, tuple[Message, Header]] = {}
        self._refused = refused

    def put(self, name: str, frames: Any) -> bool:
        """Keep the frames; says whether they took the place of some that nobody looked at."""
        unseen = name in self._frames
        self._frames[name] = frames
        return unseen

    def newest(self, name: str, kind: type[M]) -> tuple[M, Header] | None:
        """See `Source`."""
        frames = self._frames.pop(name, None)
        if frames is not None:
            topic = topic_named(name)
            try:
                self._opened[name] = decode(frames, topic)
            except WireError as error:
                self._refused(topic, error)
        return checked(self._opened.get(name), kind)


def checked(entry: tuple[Message, Header] | None, kind: type[M]) -> tuple[M, Header] | None:
    """The entry, known to be of that kind."""
    if entry is None:
        return None
    message, header = entry
    if not isinstance(message, kind):
        raise TypeError(f"{type(message).__name__} is no {kind.__name__}")
    return message, header
