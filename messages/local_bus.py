"""Deliver messages between the nodes of one process without encoding them.

A publisher passes each message to the subscribers in its process. The socket is used only while
another process has subscribed. A subscriber checks the same properties as for messages from
sockets: writer, plan, order, types, shapes and ranges. Arrays of at most `INLINE_BYTES` are copied,
because a sender can reuse their memory. Larger arrays are shared. All arrays are read-only for the
subscribers.

A message handler runs in a callback of the event loop after the sender's callback, never inside
`send`.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel

from flexsheet.messages.base import Header, Message
from flexsheet.messages.topics import Delivery, Topic
from flexsheet.messages.wire import INLINE_BYTES, Codec, Envelope, WireError, get_codec

if TYPE_CHECKING:
    from flexsheet.messages.bus import Subscriber

_SCALARS = frozenset((bool, int, float, str, type(None)))


class LocalEnvelope(Envelope):
    """A message for the subscribers in the sender's process.

    The message is copied once, for all subscribers together, and a valid one is validated once.

    array_bytes: total size of the message's arrays.
    """

    __slots__ = ("_message", "array_bytes")

    def __init__(self, codec: Codec, header: Header, original: Message) -> None:
        self.codec, self.header = codec, header
        self._message: Message | None = None
        self.array_bytes = 0
        self.fields = self._share_fields(original.__dict__)

    def open(self) -> Message:
        """Return the validated message, which is the same object for all subscribers.

        Raises WireError if a field is invalid.
        """
        if self._message is None:
            self._message = super().open()
        return self._message

    def _share_fields(self, fields: dict[Any, Any]) -> dict[Any, Any]:
        shared = fields.copy()
        for name, value in fields.items():
            if type(value) not in _SCALARS:
                shared[name] = self._share(value)
        return shared

    def _share(self, value: Any) -> Any:
        """Return a copy of a value in which arrays are read-only and models are dictionaries."""
        if isinstance(value, np.ndarray):
            self.array_bytes += value.nbytes
            array = value.copy() if value.nbytes <= INLINE_BYTES else value.view()
            array.setflags(write=False)
            return array
        if isinstance(value, BaseModel):
            return self._share_fields(value.__dict__)
        if isinstance(value, tuple | list):
            return tuple(map(self._share, value))
        if isinstance(value, dict):
            return self._share_fields(value)
        return value


class LocalChannel:
    """A channel that passes the messages of one node on one topic to subscribers in its process."""

    def __init__(self) -> None:
        self._readers: list[LocalConnection] = []
        self._last: LocalEnvelope | None = None

    def send(self, topic: Topic, message: Message, header: Header) -> None:
        """Pass a message to all subscribers in this process.

        Raises WireError if the arrays are larger than the topic permits.
        """
        latched = topic.delivery is Delivery.LATCHED
        if not (self._readers or latched):
            return
        envelope = LocalEnvelope(get_codec(type(message)), header, message)
        if envelope.array_bytes > topic.max_bytes:
            raise WireError(
                "size",
                f"{envelope.codec.name}: the arrays have {envelope.array_bytes} bytes, "
                f"at most {topic.max_bytes} are allowed",
            )
        if latched:
            self._last = envelope
        for reader in self._readers:
            reader.put(envelope)

    def forget(self) -> None:
        """Discard the message that is stored for late subscribers."""
        self._last = None

    def interrupt(self) -> None:
        """Report to the subscribers that the publishing node has disconnected."""
        for reader in self._readers:
            reader.report_end()

    def add(self, reader: LocalConnection) -> None:
        self._readers.append(reader)
        if self._last is not None:
            reader.put(self._last)

    def remove(self, reader: LocalConnection) -> None:
        if reader in self._readers:
            self._readers.remove(reader)


class LocalBus:
    """The message channels inside one process, one for each endpoint.

    endpoints: endpoints to which the publishers of this process bind.
    """

    def __init__(self, endpoints: Iterable[str]) -> None:
        self._channels = {endpoint: LocalChannel() for endpoint in endpoints}

    def find(self, endpoints: Sequence[str]) -> LocalChannel | None:
        """Return the message channel of an endpoint in this process.

        If several endpoints have a channel, the channel of the first is returned. Return None if no
        endpoint has a channel.
        """
        return next((self._channels[one] for one in endpoints if one in self._channels), None)


class LocalConnection:
    """A connection of a subscriber to publishers in its own process.

    writers: names of the nodes whose messages are accepted; None means any node.
    max_waiting: maximum number of messages in the queue. A full queue drops the newest message, and
        the subscriber counts it as lost.
    """

    def __init__(
        self,
        receiver: Subscriber,
        channels: Sequence[LocalChannel],
        writers: frozenset[str] | None,
        *,
        max_waiting: int,
    ) -> None:
        self._receiver, self._channels, self._writers = receiver, channels, writers
        self._latest_only = receiver.topic.delivery is Delivery.LATEST
        self._waiting: deque[LocalEnvelope] = deque()
        self._max_waiting, self._scheduled = max_waiting, False
        self._loop: asyncio.AbstractEventLoop | None = None

    @property
    def closed(self) -> bool:
        return self._loop is None

    def open(self) -> None:
        """Start to receive messages. This requires a running event loop."""
        self._loop = asyncio.get_running_loop()
        for channel in self._channels:
            channel.add(self)

    def close(self) -> None:
        """Stop receiving messages, and discard the messages in the queue."""
        for channel in self._channels:
            channel.remove(self)
        self._waiting.clear()
        self._loop = None

    def put(self, envelope: LocalEnvelope) -> None:
        """Add a message to the queue, and schedule its delivery.

        If the queue is full, the message is dropped.
        """
        if len(self._waiting) < self._max_waiting:
            self._waiting.append(envelope)
        if not self._scheduled and self._loop is not None:
            self._scheduled = True
            self._loop.call_soon(self._read)

    def report_end(self) -> None:
        """Schedule a call of `on_disconnected` after all queued messages have been delivered."""
        if self._receiver.on_disconnected is not None and self._loop is not None:
            self._loop.call_soon(self._receiver.on_disconnected)

    def _read(self) -> None:
        """Deliver the messages that are in the queue at the start of this call."""
        self._scheduled = False
        waiting, accept = self._waiting, self._receiver.accept_header
        accepted: list[LocalEnvelope] = []
        while waiting:
            envelope = waiting.popleft()
            if not accept(envelope.header, self._writers):
                continue
            if self._latest_only:
                writer = envelope.header.writer
                older = [one for one in accepted if one.header.writer == writer]
                self._receiver.counts.dropped += len(older)
                accepted = [one for one in accepted if one.header.writer != writer]
            accepted.append(envelope)
        for envelope in accepted:
            if self.closed:
                return
            self._receiver.deliver(envelope)
