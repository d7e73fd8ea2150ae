"""Store the latest message of each topic, and decode a message only when it is needed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from flexsheet.messages.base import Header, Message
from flexsheet.messages.topics import Topic, find_topic
from flexsheet.messages.wire import WireError, decode

M = TypeVar("M", bound=Message)


class MessageSource(Protocol):
    """The interface of a source of the displayed messages: the running graph or a bag."""

    def latest(self, name: str, kind: type[M]) -> tuple[M, Header] | None:
        """Return the latest message of a topic with its header, or None before the first message.

        Raises TypeError if the message does not have the type `kind`.
        """
        ...


class LatestMessages:
    """A store of the latest message of each topic, which decodes a message only when it is read.

    refused: function that receives the topic and the error if a message cannot be decoded.
    """

    def __init__(self, refused: Callable[[Topic, WireError], None]) -> None:
        self._frames: dict[str, Any] = {}
        self._opened: dict[str, tuple[Message, Header]] = {}
        self._refused = refused

    def put(self, name: str, frames: Any) -> bool:
        """Store an encoded message, and return whether it replaces a message that was never read.

        name: name of the topic.
        frames: ZeroMQ frames (parts) of the encoded message.
        """
        unread = name in self._frames
        self._frames[name] = frames
        return unread

    def latest(self, name: str, kind: type[M]) -> tuple[M, Header] | None:
        frames = self._frames.pop(name, None)
        if frames is not None:
            topic = find_topic(name)
            try:
                self._opened[name] = decode(frames, topic)
            except WireError as error:
                self._refused(topic, error)
        return check_type(self._opened.get(name), kind)


def check_type(entry: tuple[Message, Header] | None, kind: type[M]) -> tuple[M, Header] | None:
    """Return a message and its header unchanged, after a check of the message's type.

    Raises TypeError if the message does not have the type `kind`. The entry None is also returned
    unchanged.
    """
    if entry is None:
        return None
    message, header = entry
    if not isinstance(message, kind):
        raise TypeError(
            f"expected a message of the type {kind.__name__}, found {type(message).__name__}; "
            "request the type of the topic"
        )
    return message, header
