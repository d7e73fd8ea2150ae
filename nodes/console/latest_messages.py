"""Store the latest message of each topic, and decode a message only when it is needed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from flexsheet.messages.base import Header, Message
from flexsheet.messages.topics import Topic, find_topic
from flexsheet.messages.wire import WireError, decode

M = TypeVar("M", bound=Message)


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
        """Return the latest message of a topic with its header, or None before the first message.

        Raises TypeError if the message does not have the type `kind`.
        """
        frames = self._frames.pop(name, None)
        if frames is not None:
            topic = find_topic(name)
            try:
                self._opened[name] = decode(frames, topic)
            except WireError as error:
                self._refused(topic, error)
        if name not in self._opened:
            return None
        message, header = self._opened[name]
        if not isinstance(message, kind):
            raise TypeError(
                f"expected a message of the type {kind.__name__}, found {type(message).__name__}; "
                "request the type of the topic"
            )
        return message, header
